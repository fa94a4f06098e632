/* Sampled closed loop of a robot with dry joint friction: the compiled twin of plain_closed_loop.py and
 * stick_slip.py, which explain the method and are tested to be equal. Compiled together with the C code that CasADi
 * generates for equation_of_motion, motion_derivatives and rate_map_derivative (column-major matrices).
 *
 * State: pose q (6), pose rate (6), joint PID integral (6). Sensitivities: one row of NP columns per state entry.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define N 6
#define NRIGID 52
#define NP 67
#define NSTATE 18
#define COULOMB 52
#define VISCOUS 58
#define LP 64
#define LI 65
#define LD 66
#define MAX_EVENTS_PER_SEGMENT 400
#define MAX_DELAY 64
#define NO_MARGIN 1e-12 /* rad/s, or share of the breakaway torque */

enum { COULOMB_VISCOUS = 0, SMOOTHED = 1, STRIBECK = 2 };
enum { OK = 0, LEFT_REACH = 1, TOO_MANY_EVENTS = 2, SENSOR_FAILED = 3, OUT_OF_MEMORY = 4, MEASURED_OUT_OF_REACH = 5,
       SINGULAR_MASS = 6 };
enum { SENSOR_RAISED = 0, MEASURED = 1, LOST = 2 }; /* what the sensor returns */

typedef double vec[N];
typedef double rows[N][NP];

typedef struct {
    int frames, steps_per_frame, linear_hold, law, sensitivities;
    double frame_period, latency, smoothing_velocity, static_level, stribeck_velocity;
    double rigid[NRIGID];
    vec coulomb, viscous;
    double lp, li, ld, kp, kd, ki;
    vec pose, command, integral, servo_integral;
    const double *integral_sensitivity; /* (6, NP) or NULL */
    const double *reference;            /* (frames, 6) */
    const double *reference_rate;       /* (frames, 6) */
    const double *logged_commands;      /* (frames, 6), or NULL: the servo computes them */
    const signed char *lost;            /* (frames) 1 where the ideal sensor measures nothing, or NULL */
} problem;

typedef struct {
    double *pose, *rate, *torque, *command, *measured; /* (frames, 6) */
    signed char *measured_ok;                          /* (frames) */
    double *pose_sensitivity;                          /* (frames, 6, NP) or NULL */
    int events, failed_frame;
} trajectory;

typedef int (*measure_fn)(int frame, const double *pose, double *measured);

typedef struct { vec pose, rate, integral; } state;

typedef struct { vec value, slope, rate; } command; /* U(t) = value + slope t; U_dot as the joint PID sees it */

typedef struct {
    double mass[N * N], jacobian[N * N], cholesky[N][N];
    vec bias, bias_acceleration, angle;
    vec velocity, torque, net_torque, stick_force, acceleration;
    vec inverse_rows[N];       /* M^-1 J^T, column i for joint i */
    double compliance[N][N];   /* J M^-1 J^T */
} evaluation;

typedef struct { double q[N][NP], v[N][NP], z[N][NP]; } tangent;

typedef struct {
    const problem *p;
    int mode[N]; /* 0: stuck, +1 or -1: slipping that way */
    command u;
    rows du_value, du_slope, du_rate;
    state stage_state[4];
    evaluation stage[4];
    double stage_time[4];
    tangent x, k[4], trial;
    int events;
    const double **arg;
    double **res;
    casadi_int *iw;
    double *w;
} context;

static double dot_row(const double *matrix, int row, const double *v) {
    double sum = 0;
    for (int j = 0; j < N; j++) sum += matrix[row + N * j] * v[j];
    return sum;
}

static int cholesky(const double *a, double l[N][N]) {
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            double sum = a[i + N * j];
            for (int k = 0; k < j; k++) sum -= l[i][k] * l[j][k];
            if (i == j) {
                if (!(sum > 0)) return 0;
                l[i][i] = sqrt(sum);
            } else
                l[i][j] = sum / l[j][j];
        }
    return 1;
}

static void cholesky_solve(double l[N][N], double *b) {
    for (int i = 0; i < N; i++) {
        for (int k = 0; k < i; k++) b[i] -= l[i][k] * b[k];
        b[i] /= l[i][i];
    }
    for (int i = N - 1; i >= 0; i--) {
        for (int k = i + 1; k < N; k++) b[i] -= l[k][i] * b[k];
        b[i] /= l[i][i];
    }
}

static int stuck_joints(const int *mode, int *list) {
    int count = 0;
    for (int i = 0; i < N; i++)
        if (mode[i] == 0) list[count++] = i;
    return count;
}

/* Solve the symmetric positive definite system compliance[list][list] f = b in place, size count. */
static void solve_stuck(double compliance[N][N], const int *list, int count, double *b, int columns) {
    double l[N][N];
    for (int i = 0; i < count; i++)
        for (int j = 0; j <= i; j++) {
            double sum = compliance[list[i]][list[j]];
            for (int k = 0; k < j; k++) sum -= l[i][k] * l[j][k];
            l[i][j] = i == j ? sqrt(sum) : sum / l[j][j];
        }
    for (int i = 0; i < count; i++) {
        for (int k = 0; k < i; k++)
            for (int c = 0; c < columns; c++) b[i * columns + c] -= l[i][k] * b[k * columns + c];
        for (int c = 0; c < columns; c++) b[i * columns + c] /= l[i][i];
    }
    for (int i = count - 1; i >= 0; i--) {
        for (int k = i + 1; k < count; k++)
            for (int c = 0; c < columns; c++) b[i * columns + c] -= l[k][i] * b[k * columns + c];
        for (int c = 0; c < columns; c++) b[i * columns + c] /= l[i][i];
    }
}

static int needs_event(const problem *p, int i) { return p->law != SMOOTHED && p->coulomb[i] > 0; }

/* Dry friction over Coulomb torque of a joint that slips towards `mode`, and its derivative: see friction.py. */
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

static int finite_mass(const double *mass) {
    for (int i = 0; i < N * N; i++)
        if (!isfinite(mass[i])) return 0;
    return 1;
}

/* Everything at one state that does not depend on the stick modes. */
static int evaluate_terms(context *c, const state *s, double t, evaluation *e) {
    const problem *p = c->p;
    c->arg[0] = s->pose; c->arg[1] = s->rate; c->arg[2] = p->rigid;
    c->res[0] = e->mass; c->res[1] = e->bias; c->res[2] = e->jacobian;
    c->res[3] = e->bias_acceleration; c->res[4] = e->angle;
    equation_of_motion(c->arg, c->res, c->iw, c->w, 0);
    if (!cholesky(e->mass, e->cholesky)) return finite_mass(e->mass) ? SINGULAR_MASS : LEFT_REACH;
    for (int i = 0; i < N; i++) {
        e->velocity[i] = dot_row(e->jacobian, i, s->rate);
        e->torque[i] = p->lp * (c->u.value[i] + c->u.slope[i] * t - e->angle[i])
                     + p->ld * (c->u.rate[i] - e->velocity[i]) + p->li * s->integral[i];
    }
    return OK;
}

static void evaluate_compliance(evaluation *e, const int *list, int count) {
    for (int s = 0; s < count; s++) {
        int i = list[s];
        for (int j = 0; j < N; j++) e->inverse_rows[i][j] = e->jacobian[i + N * j];
        cholesky_solve(e->cholesky, e->inverse_rows[i]);
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
    for (int j = 0; j < N; j++) {
        right[j] = -e->bias[j];
        for (int i = 0; i < N; i++) right[j] += e->jacobian[i + N * j] * e->net_torque[i];
    }
    cholesky_solve(e->cholesky, right);
    memcpy(e->acceleration, right, sizeof right);
    if (!count) return;
    double force[N];
    evaluate_compliance(e, list, count);
    for (int s = 0; s < count; s++)
        force[s] = dot_row(e->jacobian, list[s], right) + e->bias_acceleration[list[s]];
    solve_stuck(e->compliance, list, count, force, 1);
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
    cholesky_solve(e->cholesky, right);
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

static void moved(const state *s, const state *slope_of, const evaluation *e, const context *c, double t, double h,
                  state *out) {
    for (int i = 0; i < N; i++) {
        out->pose[i] = s->pose[i] + h * slope_of->rate[i];
        out->rate[i] = s->rate[i] + h * e->acceleration[i];
        out->integral[i] = s->integral[i] + h * (c->u.value[i] + c->u.slope[i] * t - e->angle[i]);
    }
}

/* One classical Runge-Kutta step with fixed modes; stage 0 must hold the evaluation at s. Stages stay in the context. */
static int rk4(context *c, const state *s, double t, double h, state *out) {
    static const double fraction[4] = {0, 0.5, 0.5, 1}, weight[4] = {1 / 6.0, 1 / 3.0, 1 / 3.0, 1 / 6.0};
    c->stage_state[0] = *s;
    c->stage_time[0] = t;
    for (int k = 1; k < 4; k++) {
        moved(s, &c->stage_state[k - 1], &c->stage[k - 1], c, c->stage_time[k - 1], fraction[k] * h, &c->stage_state[k]);
        c->stage_time[k] = t + fraction[k] * h;
        int status = evaluate(c, &c->stage_state[k], c->stage_time[k], &c->stage[k]);
        if (status != OK) return status;
    }
    *out = *s;
    for (int k = 0; k < 4; k++)
        moved(out, &c->stage_state[k], &c->stage[k], c, c->stage_time[k], weight[k] * h, out);
    return OK;
}

static void multiply_add(double scale, const double *matrix, double in[N][NP], double out[N][NP]) {
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            double factor = scale * matrix[i + N * j];
            for (int p = 0; p < NP; p++) out[i][p] += factor * in[j][p];
        }
}

static void mass_solve(double l[N][N], double b[N][NP]) {
    for (int i = 0; i < N; i++) {
        for (int k = 0; k < i; k++)
            for (int p = 0; p < NP; p++) b[i][p] -= l[i][k] * b[k][p];
        for (int p = 0; p < NP; p++) b[i][p] /= l[i][i];
    }
    for (int i = N - 1; i >= 0; i--) {
        for (int k = i + 1; k < N; k++)
            for (int p = 0; p < NP; p++) b[i][p] -= l[k][i] * b[k][p];
        for (int p = 0; p < NP; p++) b[i][p] /= l[i][i];
    }
}

/* d(net torque) of every joint; for stuck joints without the friction that follows from the constraint. */
static void torque_tangent(const context *c, int stage, rows angle, rows velocity, const tangent *x, rows out) {
    const problem *p = c->p;
    const evaluation *e = &c->stage[stage];
    const double t = c->stage_time[stage], *integral = c->stage_state[stage].integral;
    for (int i = 0; i < N; i++) {
        double error = c->u.value[i] + c->u.slope[i] * t - e->angle[i];
        double damping = p->ld;
        if (c->mode[i]) damping += p->viscous[i];
        if (c->mode[i]) damping += p->coulomb[i] * dry_slope(p, e->velocity[i], c->mode[i]);
        for (int k = 0; k < NP; k++)
            out[i][k] = p->lp * (c->du_value[i][k] + t * c->du_slope[i][k] - angle[i][k]) + p->ld * c->du_rate[i][k]
                      - damping * velocity[i][k] + p->li * x->z[i][k];
        out[i][LP] += error;
        out[i][LI] += integral[i];
        out[i][LD] += c->u.rate[i] - e->velocity[i];
        if (c->mode[i]) {
            out[i][COULOMB + i] -= dry_level(p, e->velocity[i], c->mode[i]);
            out[i][VISCOUS + i] -= e->velocity[i];
        }
    }
}

/* Time derivative of the sensitivities at one stage: implicit differentiation of the equation of motion. */
static void stage_tangent(context *c, int stage, const tangent *x, tangent *out) {
    const evaluation *e = &c->stage[stage];
    const state *s = &c->stage_state[stage];
    double t = c->stage_time[stage];
    double by_pose[N * N], by_rate[N * N], columns[N * NRIGID], crank_by_pose[N * N], crank_by_rate[N * N];
    rows angle, velocity, torque;
    c->arg[0] = s->pose; c->arg[1] = s->rate; c->arg[2] = e->acceleration; c->arg[3] = e->net_torque;
    c->arg[4] = c->p->rigid;
    c->res[0] = by_pose; c->res[1] = by_rate; c->res[2] = columns; c->res[3] = crank_by_pose; c->res[4] = crank_by_rate;
    motion_derivatives(c->arg, c->res, c->iw, c->w, 0);
    memset(angle, 0, sizeof angle);
    memset(velocity, 0, sizeof velocity);
    multiply_add(1, e->jacobian, (void *)x->q, angle);
    multiply_add(0.5, crank_by_rate, (void *)x->q, velocity);
    multiply_add(1, e->jacobian, (void *)x->v, velocity);
    torque_tangent(c, stage, angle, velocity, x, torque);
    for (int i = 0; i < N; i++)
        for (int k = 0; k < NP; k++) {
            out->q[i][k] = x->v[i][k];
            out->z[i][k] = c->du_value[i][k] + t * c->du_slope[i][k] - angle[i][k];
        }
    memset(out->v, 0, sizeof out->v);
    for (int i = 0; i < N; i++)
        for (int k = 0; k < NRIGID; k++) out->v[i][k] = -columns[i + N * k];
    multiply_add(-1, by_pose, (void *)x->q, out->v);
    multiply_add(-1, by_rate, (void *)x->v, out->v);
    for (int i = 0; i < N; i++)
        if (c->mode[i])
            for (int j = 0; j < N; j++)
                for (int k = 0; k < NP; k++) out->v[j][k] += e->jacobian[i + N * j] * torque[i][k];
    mass_solve((void *)e->cholesky, out->v);
    int list[N], count = stuck_joints(c->mode, list);
    if (!count) return;
    double force[N * NP];
    for (int n = 0; n < count; n++) {
        int i = list[n];
        double *row = force + n * NP;
        memset(row, 0, NP * sizeof *row);
        for (int j = 0; j < N; j++)
            for (int k = 0; k < NP; k++)
                row[k] -= crank_by_pose[i + N * j] * x->q[j][k] + crank_by_rate[i + N * j] * x->v[j][k]
                        + e->jacobian[i + N * j] * out->v[j][k];
    }
    solve_stuck((void *)e->compliance, list, count, force, NP);
    for (int n = 0; n < count; n++)
        for (int j = 0; j < N; j++)
            for (int k = 0; k < NP; k++) out->v[j][k] += e->inverse_rows[list[n]][j] * force[n * NP + k];
}

static void tangent_moved(const tangent *x, const tangent *k, double h, tangent *out) {
    const double *a = &x->q[0][0], *b = &k->q[0][0];
    double *o = &out->q[0][0];
    for (int i = 0; i < NSTATE * NP; i++) o[i] = a[i] + h * b[i];
}

/* Sensitivities over the step whose stages are stored. */
static void rk4_tangent(context *c, double h) {
    static const double fraction[4] = {0, 0.5, 0.5, 1}, weight[4] = {1 / 6.0, 1 / 3.0, 1 / 3.0, 1 / 6.0};
    for (int k = 0; k < 4; k++) {
        if (k == 0) c->trial = c->x;
        else tangent_moved(&c->x, &c->k[k - 1], fraction[k] * h, &c->trial);
        stage_tangent(c, k, &c->trial, &c->k[k]);
    }
    for (int k = 0; k < 4; k++) tangent_moved(&c->x, &c->k[k], weight[k] * h, &c->x);
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

/* Take the velocities of the joints in the list out of the pose rate, as an impulse would. */
static void stop_joints(evaluation *e, state *s, const int *list, int count) {
    if (count == N) { memset(s->rate, 0, sizeof s->rate); return; }
    if (!count) return;
    double impulse[N];
    evaluate_compliance(e, list, count);
    for (int k = 0; k < count; k++) impulse[k] = dot_row(e->jacobian, list[k], s->rate);
    solve_stuck(e->compliance, list, count, impulse, 1);
    for (int k = 0; k < count; k++)
        for (int j = 0; j < N; j++) s->rate[j] -= e->inverse_rows[list[k]][j] * impulse[k];
}

static int trial_margin(context *c, const state *s, double t, double h, state *out, evaluation *end, double *margin) {
    int ignored, status = rk4(c, s, t, h, out);
    if (status == OK) status = evaluate(c, out, t + h, end);
    if (status == OK) *margin = mode_margin(c, end, &ignored);
    return status;
}

/* Modes that hold at both ends of a step may break in between (a joint that reverses twice). The stages give a hint;
 * where a step of half the length confirms it, that becomes the step: returns whether it did. */
static int breaks_halfway(context *c, const state *s, double t, double *h, state *out, evaluation *end, double *margin,
                          int *status) {
    int joint;
    state half;
    evaluation half_end;
    if (mode_margin(c, &c->stage[1], &joint) >= 0 && mode_margin(c, &c->stage[2], &joint) >= 0) return 0;
    *status = trial_margin(c, s, t, *h / 2, &half, &half_end, margin);
    if (*status != OK) return 0;
    if (*margin >= 0) { /* a false alarm: restore the stages of the whole step */
        *status = rk4(c, s, t, *h, out);
        return 0;
    }
    *h /= 2;
    *out = half;
    *end = half_end;
    return 1;
}

/* The step in (0, h] at which the modes stop holding, to rounding: regula falsi (Illinois) on the margin. A joint that
 * has just started from rest has no margin yet: then the bracket is found by halving; *held tells whether there is one. */
static int locate_event(context *c, const state *s, double t, double h, double margin_at_h, double *step, state *out,
                        evaluation *end, int *held) {
    int joint, side = 0, status;
    double low = 0, high = h, at_high = margin_at_h, at_low = mode_margin(c, &c->stage[0], &joint), margin;
    for (int halving = 0; at_low < NO_MARGIN && halving < 40; halving++) {
        status = trial_margin(c, s, t, high / 2, out, end, &margin);
        if (status != OK) return status;
        if (margin > 0) { low = high / 2; at_low = margin; break; }
        high /= 2; at_high = margin;
    }
    *held = at_low > 0;
    for (int iteration = 0; *held && iteration < 80 && high - low > 1e-15 + 1e-13 * h; iteration++) {
        double middle = (low * at_high - high * at_low) / (at_high - at_low);
        if (iteration > 40 || !(middle > low && middle < high)) middle = 0.5 * (low + high);
        status = trial_margin(c, s, t, middle, out, end, &margin);
        if (status != OK) return status;
        if (margin <= 0) {
            high = middle; at_high = margin;
            if (margin == 0) break;
            if (side < 0) at_low /= 2;
            side = -1;
        } else {
            low = middle; at_low = margin;
            if (side > 0) at_high /= 2;
            side = 1;
        }
    }
    *step = high;
    return trial_margin(c, s, t, high, out, end, &margin);
}

/* The jump of the sensitivities where a slipping joint comes to rest: its velocity zero fixes the event time. */
static void saltation(context *c, const evaluation *before, const evaluation *after, const state *s, int joint) {
    double approach = dot_row(before->jacobian, joint, before->acceleration) + before->bias_acceleration[joint];
    if (fabs(approach) < 1e-9) return;
    double by_pose[N * N];
    c->arg[0] = s->pose; c->arg[1] = s->rate;
    c->res[0] = by_pose;
    rate_map_derivative(c->arg, c->res, c->iw, c->w, 0);
    for (int k = 0; k < NP; k++) {
        double velocity = 0;
        for (int j = 0; j < N; j++)
            velocity += by_pose[joint + N * j] * c->x.q[j][k] + before->jacobian[joint + N * j] * c->x.v[j][k];
        for (int j = 0; j < N; j++)
            c->x.v[j][k] += (after->acceleration[j] - before->acceleration[j]) * velocity / approach;
    }
}

/* `held` is 0 where a joint that starts from rest turns back at once: it sticks. */
static int handle_event(context *c, state *s, double t, evaluation *end, int held) {
    int joint;
    mode_margin(c, end, &joint);
    if (c->mode[joint] == 0) {
        c->mode[joint] = end->stick_force[joint] > 0 ? 1 : -1;
        return evaluate(c, s, t, &c->stage[0]);
    }
    int list[N], count;
    evaluation before = *end;
    c->mode[joint] = 0;
    count = stuck_joints(c->mode, list);
    stop_joints(end, s, list, count);
    int status = evaluate_terms(c, s, t, end);
    if (status != OK) return status;
    if (held) decide_modes(c, end, list, count);
    status = evaluate(c, s, t, &c->stage[0]);
    if (status == OK && c->p->sensitivities) saltation(c, &before, &c->stage[0], s, joint);
    return status;
}

/* Integrate over a time span with one command. Modes are decided anew at its start, where the torque jumps. */
static int segment(context *c, state *s, double duration, int steps) {
    int list[N], status, events = 0;
    evaluation end;
    status = evaluate_terms(c, s, 0, &c->stage[0]);
    if (status != OK) return status;
    for (int i = 0; i < N; i++)
        if (!needs_event(c->p, i)) c->mode[i] = c->stage[0].velocity[i] < 0 ? -1 : 1;
    decide_modes(c, &c->stage[0], list, stuck_joints(c->mode, list));
    status = evaluate(c, s, 0, &c->stage[0]);
    double t = 0;
    for (int n = 1; n <= steps && status == OK; n++) {
        double target = duration * n / steps;
        while (status == OK && t < target) {
            state next;
            int joint;
            double h = target - t;
            status = rk4(c, s, t, h, &next);
            if (status == OK) status = evaluate(c, &next, t + h, &end);
            if (status != OK) break;
            double margin = mode_margin(c, &end, &joint);
            int held = 1, event = margin < 0 || breaks_halfway(c, s, t, &h, &next, &end, &margin, &status);
            if (status != OK) break;
            if (event) {
                if (++events > MAX_EVENTS_PER_SEGMENT) return TOO_MANY_EVENTS;
                status = locate_event(c, s, t, h, margin, &h, &next, &end, &held);
                if (status != OK) break;
                c->events++;
            }
            if (c->p->sensitivities) rk4_tangent(c, h);
            *s = next;
            t = event ? t + h : target;
            if (event) status = handle_event(c, s, t, &end, held);
            else {
                stop_joints(&end, s, list, stuck_joints(c->mode, list));
                for (int i = 0; i < N; i++)
                    if (!needs_event(c->p, i)) c->mode[i] = end.velocity[i] < 0 ? -1 : 1;
                status = evaluate(c, s, t, &c->stage[0]);
            }
        }
    }
    return status;
}

typedef struct {
    vec previous_measured, integral, last_command;
    rows d_previous, d_integral, d_command;
    double elapsed;
} servo;

/* Visual servo, eq. 30, at one good frame: command and its sensitivities. */
static void servo_update(context *c, servo *v, int k, const double *measured, const double *d_measured) {
    const problem *p = c->p;
    const double period = p->frame_period;
    vec demand, zero = {0};
    evaluation e;
    for (int i = 0; i < N; i++) {
        double error = p->reference[N * k + i] - measured[i];
        double rate = (measured[i] - v->previous_measured[i]) / v->elapsed;
        v->integral[i] += period * error;
        demand[i] = p->kp * error + p->kd * (p->reference_rate[N * k + i] - rate) + p->ki * v->integral[i];
    }
    c->arg[0] = measured; c->arg[1] = zero; c->arg[2] = p->rigid;
    c->res[0] = e.mass; c->res[1] = e.bias; c->res[2] = e.jacobian; c->res[3] = e.bias_acceleration; c->res[4] = e.angle;
    equation_of_motion(c->arg, c->res, c->iw, c->w, 0);
    for (int i = 0; i < N; i++) v->last_command[i] = dot_row(e.jacobian, i, demand);
    if (p->sensitivities) {
        double by_pose[N * N];
        rows d_demand;
        c->arg[0] = measured; c->arg[1] = demand;
        c->res[0] = by_pose;
        rate_map_derivative(c->arg, c->res, c->iw, c->w, 0);
        for (int i = 0; i < N; i++)
            for (int n = 0; n < NP; n++) {
                double d = d_measured[i * NP + n];
                double d_rate = (d - v->d_previous[i][n]) / v->elapsed;
                v->d_integral[i][n] -= period * d;
                d_demand[i][n] = -p->kp * d - p->kd * d_rate + p->ki * v->d_integral[i][n];
                v->d_previous[i][n] = d;
            }
        memset(v->d_command, 0, sizeof v->d_command);
        multiply_add(1, e.jacobian, d_demand, v->d_command);
        multiply_add(1, by_pose, v->d_previous, v->d_command);
    }
    memcpy(v->previous_measured, measured, sizeof(vec));
    v->elapsed = 0;
}

typedef struct { vec value; rows tangent; } issued; /* a command on its way to the joint controllers */

/* Let command number `newest` act, coming from the one before it. */
static void apply_command(context *c, const issued *ring, int newest) {
    const problem *p = c->p;
    const issued *now = &ring[(newest + MAX_DELAY) % MAX_DELAY], *before = &ring[(newest + MAX_DELAY - 1) % MAX_DELAY];
    for (int i = 0; i < N; i++) {
        c->u.rate[i] = (now->value[i] - before->value[i]) / p->frame_period;
        c->u.value[i] = p->linear_hold ? before->value[i] : now->value[i];
        c->u.slope[i] = p->linear_hold ? c->u.rate[i] : 0;
        for (int k = 0; k < NP && p->sensitivities; k++) {
            c->du_rate[i][k] = (now->tangent[i][k] - before->tangent[i][k]) / p->frame_period;
            c->du_value[i][k] = p->linear_hold ? before->tangent[i][k] : now->tangent[i][k];
            c->du_slope[i][k] = p->linear_hold ? c->du_rate[i][k] : 0;
        }
    }
}

static int steps_in(const problem *p, double duration) {
    int steps = (int)ceil(duration / p->frame_period * p->steps_per_frame - 1e-9);
    return steps < 1 ? 1 : steps;
}

static int frame_command(context *c, servo *v, int k, const state *s, measure_fn measure, trajectory *out) {
    const problem *p = c->p;
    double measured[N];
    int good = 1;
    memcpy(measured, s->pose, sizeof measured);
    if (measure) {
        int answer = measure(k, s->pose, measured);
        if (answer != MEASURED && answer != LOST) return SENSOR_FAILED;
        good = answer == MEASURED;
    } else if (p->lost && p->lost[k]) {
        good = 0;
        for (int i = 0; i < N; i++) measured[i] = NAN;
    }
    v->elapsed += p->frame_period;
    memcpy(out->measured + N * k, measured, sizeof measured);
    out->measured_ok[k] = (signed char)good;
    if (p->logged_commands)
        memcpy(v->last_command, p->logged_commands + N * k, sizeof(vec));
    else if (good)
        servo_update(c, v, k, measured, &c->x.q[0][0]);
    memcpy(out->command + N * k, v->last_command, sizeof(vec));
    for (int i = 0; i < N; i++)
        if (!isfinite(v->last_command[i])) return MEASURED_OUT_OF_REACH;
    return OK;
}

static int record_torque(context *c, const state *s, double *torque) {
    int status = evaluate_terms(c, s, 0, &c->stage[0]);
    if (status == OK) memcpy(torque, c->stage[0].torque, sizeof(vec));
    return status;
}

static int run_frames(context *c, servo *v, issued *ring, state *s, measure_fn measure, trajectory *out) {
    const problem *p = c->p;
    int whole = (int)floor(p->latency / p->frame_period + 1e-9), status = OK;
    double rest = p->latency - whole * p->frame_period;
    if (rest < 1e-12) rest = 0;
    for (int k = 0; k < p->frames; k++) {
        out->failed_frame = k;
        memcpy(out->pose + N * k, s->pose, sizeof(vec));
        memcpy(out->rate + N * k, s->rate, sizeof(vec));
        if (out->pose_sensitivity) memcpy(out->pose_sensitivity + (size_t)N * NP * k, c->x.q, sizeof c->x.q);
        status = frame_command(c, v, k, s, measure, out);
        if (status != OK) return status;
        issued *slot = &ring[k % MAX_DELAY];
        memcpy(slot->value, v->last_command, sizeof(vec));
        if (p->sensitivities) memcpy(slot->tangent, v->d_command, sizeof(rows));
        if (rest > 0) {
            apply_command(c, ring, k - whole - 1);
            status = record_torque(c, s, out->torque + N * k);
            if (status == OK) status = segment(c, s, rest, steps_in(p, rest));
            if (status != OK) return status;
        }
        apply_command(c, ring, k - whole);
        if (rest == 0) status = record_torque(c, s, out->torque + N * k);
        if (status != OK) return status;
        if (k + 1 == p->frames) break;
        status = segment(c, s, p->frame_period - rest, steps_in(p, p->frame_period - rest));
        if (status != OK) return status;
    }
    out->failed_frame = -1;
    return OK;
}

static casadi_int largest(casadi_int a, casadi_int b) { return a > b ? a : b; }

static int allocate_work(context *c) {
    casadi_int arg = 0, res = 0, iw = 0, w = 0, a, r, i, n;
    equation_of_motion_work(&a, &r, &i, &n);
    arg = largest(arg, a); res = largest(res, r); iw = largest(iw, i); w = largest(w, n);
    motion_derivatives_work(&a, &r, &i, &n);
    arg = largest(arg, a); res = largest(res, r); iw = largest(iw, i); w = largest(w, n);
    rate_map_derivative_work(&a, &r, &i, &n);
    arg = largest(arg, a); res = largest(res, r); iw = largest(iw, i); w = largest(w, n);
    c->arg = calloc((size_t)arg + 1, sizeof *c->arg);
    c->res = calloc((size_t)res + 1, sizeof *c->res);
    c->iw = calloc((size_t)iw + 1, sizeof *c->iw);
    c->w = calloc((size_t)w + 1, sizeof *c->w);
    return c->arg && c->res && c->iw && c->w;
}

CASADI_SYMBOL_EXPORT int closed_loop_run(const problem *p, measure_fn measure, trajectory *out) {
    context *c = calloc(1, sizeof *c);
    servo *v = calloc(1, sizeof *v);
    issued *ring = calloc(MAX_DELAY, sizeof *ring);
    int status = OUT_OF_MEMORY;
    if (c && v && ring && allocate_work(c)) {
        state s;
        c->p = p;
        memcpy(s.pose, p->pose, sizeof(vec));
        memset(s.rate, 0, sizeof(vec));
        memcpy(s.integral, p->integral, sizeof(vec));
        memcpy(v->integral, p->servo_integral, sizeof(vec));
        memcpy(v->last_command, p->command, sizeof(vec));
        memcpy(v->previous_measured, p->pose, sizeof(vec));
        if (p->integral_sensitivity) memcpy(c->x.z, p->integral_sensitivity, sizeof c->x.z);
        for (int k = 0; k < MAX_DELAY; k++) memcpy(ring[k].value, p->command, sizeof(vec));
        status = run_frames(c, v, ring, &s, measure, out);
        out->events = c->events;
    }
    if (c) { free((void *)c->arg); free(c->res); free(c->iw); free(c->w); }
    free(c); free(v); free(ring);
    return status;
}
