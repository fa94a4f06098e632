/* The friction law of a joint: see joints.py. */

static int stuck_joints(const int *mode, int *list) {
    int count = 0;
    for (int i = 0; i < N; i++)
        if (mode[i] == 0) list[count++] = i;
    return count;
}

static int needs_event(const problem *p, int i) { return p->law != SMOOTHED && p->coulomb[i] > 0; }

/* Dry friction over Coulomb torque of a joint that slips towards `mode`, and its derivative: see joints.py. */
static double dry_level(const problem *p, double velocity, int mode) {
    if (p->law == SMOOTHED) return tanh(velocity / p->smoothing_velocity);
    if (p->law == STRIBECK) {
        double ratio = velocity / p->stribeck_velocity;
        return mode * (1 + (p->static_level - 1) * exp(-ratio * ratio));
    }
    return mode;
}

static double dry_slope(const problem *p, double velocity, int mode) {
    if (p->law == SMOOTHED) {
        double dry = tanh(velocity / p->smoothing_velocity);
        return (1 - dry * dry) / p->smoothing_velocity;
    }
    if (p->law == STRIBECK) {
        double ratio = velocity / p->stribeck_velocity;
        return -2 * mode * (p->static_level - 1) * ratio / p->stribeck_velocity * exp(-ratio * ratio);
    }
    return 0;
}

static double breakaway(const problem *p, int i) { return p->static_level * p->coulomb[i]; }

static double slip_friction(const problem *p, const evaluation *e, int i, int mode) {
    return p->coulomb[i] * dry_level(p, e->velocity[i], mode) + p->viscous[i] * e->velocity[i];
}
