/* Elastic joints, seen from the motors, where encoders, joint PID and friction are: see joints.py. */

static int elastic(const problem *p) { return p->stiffness > 0; }

/* The motors stand for the cranks in what the joint PID and friction feel. */
static void wind_springs(const problem *p, const state *s, evaluation *e) {
    for (int i = 0; i < N; i++) {
        e->spring[i] = p->stiffness * (s->motor[i] - e->angle[i]) + p->damping * (s->motor_rate[i] - e->velocity[i]);
        e->angle[i] = s->motor[i];
        e->velocity[i] = s->motor_rate[i];
    }
}

/* Springs move the platform; a motor that sticks gets the friction torque that keeps it at rest. */
static void accelerate_elastic(const context *c, evaluation *e) {
    vec right;
    for (int i = 0; i < N; i++) {
        double left = e->net_torque[i] - e->spring[i];
        e->motor_acceleration[i] = c->mode[i] ? left / c->p->motor_inertia : 0;
        if (c->mode[i]) continue;
        e->stick_force[i] = left;
        e->net_torque[i] -= left;
    }
    for (int j = 0; j < N; j++) {
        right[j] = -e->bias[j];
        for (int i = 0; i < N; i++) right[j] += e->jacobian[i + N * j] * e->spring[i];
    }
    cholesky_solve(e->cholesky, N, right);
    memcpy(e->acceleration, right, sizeof right);
}

/* Motors at rest do not feel each other: each sticks where its friction can carry the torque that is left. */
static void decide_motor_modes(context *c, const evaluation *e, const int *list, int count) {
    for (int s = 0; s < count; s++) {
        int i = list[s];
        double left = e->torque[i] - e->spring[i];
        c->mode[i] = fabs(left) < breakaway(c->p, i) ? 0 : left >= 0 ? 1 : -1;
    }
}
