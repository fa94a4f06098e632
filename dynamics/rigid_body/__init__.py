"""Virtual-work dynamics in CasADi: legs, equation of motion, and the functions of one robot."""
