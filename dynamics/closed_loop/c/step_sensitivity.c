/* Sensitivities over the steps of the integrator, the exact derivative of what it computes: see sensitivity.py.
 * One row per state entry, one column for each of the 67 parameters, one for the length of the present step, and 24 for
 * the start state if wanted.
 */

/* out += factor * in, over the columns in use: in blocks of 4, which compilers turn into vector instructions. */
static inline void add_row(double factor, const double *restrict in, double *restrict out, int width) {
    for (int k = 0; k < width; k += 4)
        for (int j = 0; j < 4; j++) out[k + j] += factor * in[k + j];
}

static inline void scale_row(double factor, double *out, int width) {
    for (int k = 0; k < width; k += 4)
        for (int j = 0; j < 4; j++) out[k + j] *= factor;
}

static void multiply_add(const context *c, double scale, const double *matrix, row *in, row *out) {
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) add_row(scale * matrix[i + N * j], in[j], out[i], c->width);
}

/* Solve L L^T x = b in place for n rows b. */
static void solve_rows(const factor l, int n, row *b, int width) {
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++) add_row(-l[i][k], b[k], b[i], width);
        scale_row(l[i][i], b[i], width);
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) add_row(-l[k][i], b[k], b[i], width);
        scale_row(l[i][i], b[i], width);
    }
}

/* d(command - crank angle), and d(net torque) of every joint; for stuck joints without the friction that holds them. */
static void torque_tangent(const context *c, const evaluation *e, const state *s, rows velocity, const tangent *x,
                           const tangent *slope, rows out) {
    const problem *p = c->p;
    memset(out, 0, sizeof(rows));
    for (int i = 0; i < N; i++) {
        double damping = p->ld;
        if (c->mode[i]) damping += p->viscous[i] + p->coulomb[i] * dry_slope(p, e->velocity[i], c->mode[i]);
        add_row(p->lp, slope->z[i], out[i], c->width);
        add_row(p->ld, c->du_rate[i], out[i], c->width);
        add_row(-damping, velocity[i], out[i], c->width);
        add_row(p->li, x->z[i], out[i], c->width);
        out[i][LP] += e->error[i];
        out[i][LI] += s->integral[i];
        out[i][LD] += c->u.rate[i] - e->velocity[i];
        if (c->mode[i]) {
            out[i][COULOMB + i] -= dry_level(p, e->velocity[i], c->mode[i]);
            out[i][VISCOUS + i] -= e->velocity[i];
        }
    }
}

/* Derivative of the slope at one state: implicit differentiation of the equation of motion, for a state with
 * derivative x and a time with derivative d_time. Also that of the stick forces, unless d_stick is NULL. */
static void slope_tangent(context *c, const evaluation *e, const state *s, double t, const double *d_time,
                          const tangent *x, tangent *out, row *d_stick) {
    const int width = c->width;
    double by_pose[N * N], by_rate[N * N], columns[N * NRIGID], crank_by_pose[N * N], crank_by_rate[N * N];
    rows velocity, torque, force;
    c->arg[0] = s->pose; c->arg[1] = s->rate; c->arg[2] = e->acceleration; c->arg[3] = e->net_torque;
    c->arg[4] = c->p->rigid;
    c->res[0] = by_pose; c->res[1] = by_rate; c->res[2] = columns; c->res[3] = crank_by_pose; c->res[4] = crank_by_rate;
    motion_derivatives(c->arg, c->res, c->iw, c->w, 0);
    memcpy(out->q, x->v, sizeof(rows));
    memcpy(out->z, c->du_value, sizeof(rows));
    for (int i = 0; i < N && c->ramping; i++) {
        add_row(t, c->du_slope[i], out->z[i], width);
        add_row(c->u.slope[i], d_time, out->z[i], width);
    }
    memset(velocity, 0, sizeof velocity);
    multiply_add(c, -1, e->jacobian, (row *)x->q, out->z);
    multiply_add(c, 0.5, crank_by_rate, (row *)x->q, velocity);
    multiply_add(c, 1, e->jacobian, (row *)x->v, velocity);
    torque_tangent(c, e, s, velocity, x, out, torque);
    memset(out->v, 0, sizeof out->v);
    for (int i = 0; i < N; i++)
        for (int k = 0; k < NRIGID; k++) out->v[i][k] = -columns[i + N * k];
    multiply_add(c, -1, by_pose, (row *)x->q, out->v);
    multiply_add(c, -1, by_rate, (row *)x->v, out->v);
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N && c->mode[i]; j++) add_row(e->jacobian[i + N * j], torque[i], out->v[j], width);
    solve_rows(e->cholesky, N, out->v, width);
    int list[N], count = stuck_joints(c->mode, list);
    if (!count) return;
    factor l;
    memset(force, 0, sizeof force);
    for (int n = 0; n < count; n++)
        for (int i = list[n], j = 0; j < N; j++) {
            add_row(crank_by_pose[i + N * j], x->q[j], force[n], width);
            add_row(crank_by_rate[i + N * j], x->v[j], force[n], width);
            add_row(e->jacobian[i + N * j], out->v[j], force[n], width);
        }
    factor_stuck(e->compliance, list, count, l);
    solve_rows(l, count, force, width);
    for (int n = 0; n < count; n++) {
        for (int j = 0; j < N; j++) add_row(-e->inverse_rows[list[n]][j], force[n], out->v[j], width);
        for (int k = 0; k < width && d_stick; k++) d_stick[list[n]][k] = torque[list[n]][k] + force[n][k];
    }
}

/* out = x + fraction (h slope's derivative + d_length slope) at a stored stage. */
static void tangent_moved(const context *c, const tangent *x, int stage, double h, double fraction, tangent *out) {
    const double *slope[3] = {c->stage_state[stage].rate, c->stage[stage].acceleration, c->stage[stage].error};
    const row *from = x->all, *along = c->k[stage].all;
    row *to = out->all;
    for (int i = 0; i < NSTATE; i++) {
        for (int k = 0; k < c->width; k += 4)
            for (int j = 0; j < 4; j++) to[i][k + j] = from[i][k + j] + fraction * h * along[i][k + j];
        if (c->length_moves) add_row(fraction * slope[i / N][i % N], c->d_length, to[i], c->width);
    }
}

/* Sensitivities over the step whose stages are stored. */
static void rk4_tangent(context *c, double h) {
    static const double fraction[4] = {0, 0.5, 0.5, 1}, weight[4] = {1 / 6.0, 1 / 3.0, 1 / 3.0, 1 / 6.0};
    row d_time;
    for (int k = 0; k < 4; k++) {
        if (k == 0) c->trial = c->x;
        else tangent_moved(c, &c->x, k - 1, h, fraction[k], &c->trial);
        memcpy(d_time, c->d_time, sizeof d_time);
        add_row(fraction[k], c->d_length, d_time, c->width);
        slope_tangent(c, &c->stage[k], &c->stage_state[k], c->stage_time[k], d_time, &c->trial, &c->k[k], NULL);
    }
    for (int k = 0; k < 4; k++) tangent_moved(c, &c->x, k, h, weight[k], &c->x);
}

/* Derivative of the margin that reached zero, at the end of a cut step: of a velocity, or of what a stuck joint holds. */
static void margin_tangent(context *c, const evaluation *end, const state *s, double t, double *out) {
    int joint;
    mode_margin(c, end, &joint);
    memset(out, 0, sizeof(row));
    if (c->mode[joint]) {
        double by_pose[N * N];
        c->arg[0] = s->pose; c->arg[1] = s->rate;
        c->res[0] = by_pose;
        rate_map_derivative(c->arg, c->res, c->iw, c->w, 0);
        for (int j = 0; j < N; j++) {
            add_row(by_pose[joint + N * j], c->x.q[j], out, c->width);
            add_row(end->jacobian[joint + N * j], c->x.v[j], out, c->width);
        }
        return;
    }
    rows d_stick;
    row d_time;
    memcpy(d_time, c->d_time, sizeof d_time);
    d_time[LENGTH] = 1;
    slope_tangent(c, end, s, t, d_time, &c->x, &c->trial, d_stick);
    add_row(end->stick_force[joint] > 0 ? 1 : -1, d_stick[joint], out, c->width);
    out[COULOMB + joint] -= c->p->static_level;
}

/* The event sets the length of the step that it cuts: margin(end of the step, its length) = 0. */
static void length_tangent(context *c, const evaluation *end, const state *s, double t) {
    row d_margin;
    margin_tangent(c, end, s, t, d_margin);
    double approach = d_margin[LENGTH];
    memset(c->d_length, 0, sizeof c->d_length);
    if (fabs(approach) > NO_APPROACH) add_row(-1 / approach, d_margin, c->d_length, c->width);
    c->d_length[LENGTH] = 0;
    for (int i = 0; i < NSTATE; i++) {
        add_row(c->x.all[i][LENGTH], c->d_length, c->x.all[i], c->width);
        c->x.all[i][LENGTH] = 0;
    }
}

/* Sensitivities over the stored step. A step that ends on the grid is shorter by what its start is later; one that is
 * `cut` by an event has the length that the event sets: until that is known it is one more variable. */
static void step_tangent(context *c, double h, int event, int cut, const evaluation *end, const state *s, double t) {
    memset(c->d_length, 0, sizeof c->d_length);
    if (cut) c->d_length[LENGTH] = 1;
    if (!event) add_row(-1, c->d_time, c->d_length, c->width);
    c->length_moves = cut || c->time_moves;
    rk4_tangent(c, h);
    if (cut) length_tangent(c, end, s, t);
    add_row(1, c->d_length, c->d_time, c->width);
    c->time_moves = event;
}

/* Derivative of stop_joints, which changed the pose rate by `change` and left `s`, with what it left in `e`:
 * M change = -J^T impulse and J rate = 0 in the listed joints, differentiated implicitly. */
static void stop_tangent(context *c, const evaluation *e, const state *s, const int *list, int count,
                         const double *change, const double *impulse) {
    const int width = c->width;
    double by_pose[2][N * N], columns[2][N * NRIGID], map[N * N];
    factor l;
    vec zero = {0}, torque = {0};
    rows moved, force;
    for (int n = 0; n < count; n++) torque[list[n]] = -impulse[n];
    for (int on = 0; on < 2; on++) { /* the difference leaves out gravity */
        c->arg[0] = s->pose; c->arg[1] = zero; c->arg[2] = on ? change : zero; c->arg[3] = on ? torque : zero;
        c->arg[4] = c->p->rigid;
        c->res[0] = by_pose[on]; c->res[1] = NULL; c->res[2] = columns[on]; c->res[3] = c->res[4] = NULL;
        motion_derivatives(c->arg, c->res, c->iw, c->w, 0);
    }
    memset(moved, 0, sizeof moved);
    for (int i = 0; i < N; i++)
        for (int k = 0; k < NRIGID; k++) moved[i][k] = columns[0][i + N * k] - columns[1][i + N * k];
    multiply_add(c, 1, by_pose[0], c->x.q, moved);
    multiply_add(c, -1, by_pose[1], c->x.q, moved);
    solve_rows(e->cholesky, N, moved, width);
    for (int j = 0; j < N; j++) add_row(1, moved[j], c->x.v[j], width);
    c->arg[0] = s->pose; c->arg[1] = s->rate;
    c->res[0] = map;
    rate_map_derivative(c->arg, c->res, c->iw, c->w, 0);
    memset(force, 0, sizeof force);
    for (int n = 0; n < count; n++)
        for (int i = list[n], j = 0; j < N; j++) {
            add_row(map[i + N * j], c->x.q[j], force[n], width);
            add_row(e->jacobian[i + N * j], c->x.v[j], force[n], width);
        }
    factor_stuck(e->compliance, list, count, l);
    solve_rows(l, count, force, width);
    for (int n = 0; n < count; n++)
        for (int j = 0; j < N; j++) add_row(-e->inverse_rows[list[n]][j], force[n], c->x.v[j], width);
}

/* A start state moved at joints that stick: their velocities are lost at once, without a path. */
static void rest_tangent(context *c, evaluation *e, const state *s, const int *list, int count) {
    vec zero = {0};
    if (count == N) memset(c->x.v, 0, sizeof c->x.v);
    else if (count) {
        evaluate_compliance(e, list, count);
        stop_tangent(c, e, s, list, count, zero, zero);
    }
}
