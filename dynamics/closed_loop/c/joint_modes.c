/* The equation of motion for given stick modes of the joints, and which modes hold: see stick_slip.py. */

static int finite_mass(const double *mass) {
    for (int i = 0; i < N * N; i++)
        if (!isfinite(mass[i])) return 0;
    return 1;
}

/* The terms of the equation of motion at a pose and rate. Neighbouring steps and frames share their ends. */
static int know_motion(context *c, const double *pose, const double *rate) {
    double mass[N * N];
    evaluation *e = &c->known;
    if (c->knows && !memcmp(c->known_pose, pose, sizeof(vec)) && !memcmp(c->known_rate, rate, sizeof(vec))) return OK;
    memcpy(c->known_pose, pose, sizeof(vec));
    memcpy(c->known_rate, rate, sizeof(vec));
    c->arg[0] = pose; c->arg[1] = rate; c->arg[2] = c->p->rigid;
    c->res[0] = mass; c->res[1] = e->bias; c->res[2] = e->jacobian;
    c->res[3] = e->bias_acceleration; c->res[4] = e->angle;
    equation_of_motion(c->arg, c->res, c->iw, c->w, 0);
    c->knows = cholesky(mass, e->cholesky);
    if (!c->knows) return finite_mass(mass) ? SINGULAR_MASS : LEFT_REACH;
    for (int i = 0; i < N; i++) e->velocity[i] = dot_row(e->jacobian, i, rate);
    return OK;
}

/* J_theta alone, as the servo knows it, at a measured pose: often the true one. */
static void pose_jacobian(context *c, const double *pose, double *jacobian) {
    vec rest = {0};
    motion_fn motion = c->p->servo_motion ? c->p->servo_motion : equation_of_motion;
    if (!c->p->servo_motion && c->knows && !memcmp(c->known_pose, pose, sizeof(vec))) {
        memcpy(jacobian, c->known.jacobian, sizeof c->known.jacobian);
        return;
    }
    c->arg[0] = pose; c->arg[1] = rest; c->arg[2] = c->p->rigid;
    c->res[0] = c->res[1] = c->res[3] = c->res[4] = NULL; c->res[2] = jacobian;
    motion(c->arg, c->res, c->iw, c->w, 0);
}

/* Everything at one state that does not depend on the stick modes. */
static int evaluate_terms(context *c, const state *s, double t, evaluation *e) {
    const problem *p = c->p;
    int status = know_motion(c, s->pose, s->rate);
    if (status != OK) return status;
    memcpy(e, &c->known, offsetof(evaluation, error));
    if (elastic(p)) wind_springs(p, s, e);
    for (int i = 0; i < N; i++) {
        e->error[i] = c->u.value[i] + c->u.slope[i] * t - e->angle[i];
        e->torque[i] = p->lp * e->error[i] + p->ld * (c->u.rate[i] - e->velocity[i]) + p->li * s->integral[i];
    }
    return OK;
}

static void evaluate_compliance(evaluation *e, const int *list, int count) {
    for (int s = 0; s < count; s++) {
        int i = list[s];
        for (int j = 0; j < N; j++) e->inverse_rows[i][j] = e->jacobian[i + N * j];
        cholesky_solve(e->cholesky, N, e->inverse_rows[i]);
        for (int r = 0; r <= s; r++) {
            int j = list[r];
            e->compliance[i][j] = e->compliance[j][i] = dot_row(e->jacobian, j, e->inverse_rows[i]);
        }
    }
}

/* Acceleration for given modes; stuck joints get the friction torque that keeps their acceleration at zero. */
static void accelerate(const context *c, evaluation *e) {
    vec right;
    int list[N], count = stuck_joints(c->mode, list);
    for (int i = 0; i < N; i++) {
        e->stick_force[i] = 0;
        e->net_torque[i] = e->torque[i] - (c->mode[i] ? slip_friction(c->p, e, i, c->mode[i]) : 0);
    }
    if (elastic(c->p)) {
        accelerate_elastic(c, e);
        return;
    }
    for (int j = 0; j < N; j++) {
        right[j] = -e->bias[j];
        for (int i = 0; i < N; i++) right[j] += e->jacobian[i + N * j] * e->net_torque[i];
    }
    cholesky_solve(e->cholesky, N, right);
    memcpy(e->acceleration, right, sizeof right);
    if (!count) return;
    double force[N];
    evaluate_compliance(e, list, count);
    for (int s = 0; s < count; s++)
        force[s] = dot_row(e->jacobian, list[s], right) + e->bias_acceleration[list[s]];
    solve_stuck(e->compliance, list, count, force);
    for (int s = 0; s < count; s++) {
        int i = list[s];
        e->stick_force[i] = force[s];
        e->net_torque[i] -= force[s];
        for (int j = 0; j < N; j++) e->acceleration[j] -= e->inverse_rows[i][j] * force[s];
    }
    if (count == N) memset(e->acceleration, 0, sizeof e->acceleration); /* rounding must not make it creep */
}

static int evaluate(context *c, const state *s, double t, evaluation *e) {
    int status = evaluate_terms(c, s, t, e);
    if (status == OK) accelerate(c, e);
    return status;
}

/* Which of the joints at rest stick, and which way the others start: box-constrained friction by Gauss-Seidel. */
static void decide_modes(context *c, evaluation *e, const int *list, int count) {
    vec force = {0};
    if (!count) return;
    if (elastic(c->p)) {
        decide_motor_modes(c, e, list, count);
        return;
    }
    for (int s = 0; s < count; s++) c->mode[list[s]] = 1;
    evaluate_compliance(e, list, count);
    vec right;
    for (int i = 0; i < N; i++) e->net_torque[i] = e->torque[i];
    for (int i = 0; i < N; i++) {
        int at_rest = 0;
        for (int s = 0; s < count; s++) at_rest |= list[s] == i;
        if (!at_rest) e->net_torque[i] -= slip_friction(c->p, e, i, c->mode[i]);
    }
    for (int j = 0; j < N; j++) {
        right[j] = -e->bias[j];
        for (int i = 0; i < N; i++) right[j] += e->jacobian[i + N * j] * e->net_torque[i];
    }
    cholesky_solve(e->cholesky, N, right);
    for (int sweep = 0; sweep < 1000; sweep++) {
        double change = 0;
        for (int s = 0; s < count; s++) {
            int i = list[s];
            double acceleration = dot_row(e->jacobian, i, right) + e->bias_acceleration[i];
            for (int r = 0; r < count; r++) acceleration -= e->compliance[i][list[r]] * force[list[r]];
            double wanted = force[i] + acceleration / e->compliance[i][i], limit = breakaway(c->p, i);
            wanted = wanted > limit ? limit : wanted < -limit ? -limit : wanted;
            change = fmax(change, fabs(wanted - force[i]));
            force[i] = wanted;
        }
        if (change < 1e-15) break;
    }
    for (int s = 0; s < count; s++) {
        int i = list[s];
        double limit = breakaway(c->p, i);
        c->mode[i] = fabs(force[i]) < limit ? 0 : force[i] >= 0 ? 1 : -1;
    }
}

/* How far the modes are from being broken: >= 0 while they hold. Returns the joint closest to an event. */
static double mode_margin(const context *c, const evaluation *e, int *joint) {
    double least = 1;
    *joint = -1;
    for (int i = 0; i < N; i++) {
        if (!needs_event(c->p, i)) continue;
        double margin = c->mode[i] ? c->mode[i] * e->velocity[i]
                                   : 1 - fabs(e->stick_force[i]) / breakaway(c->p, i);
        if (margin < least) { least = margin; *joint = i; }
    }
    return least;
}
