"""Virtual-work dynamics in CasADi: sums over platform and legs, equation of motion, and the functions of one robot."""
