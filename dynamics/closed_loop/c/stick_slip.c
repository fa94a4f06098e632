/* Motion over a span of one command: Runge-Kutta steps cut where a joint stops or breaks away: see stick_slip.py. */

static void moved(const context *c, const state *s, const state *slope_of, const evaluation *e, double h,
                  state *out) {
    for (int i = 0; i < N; i++) {
        out->pose[i] = s->pose[i] + h * slope_of->rate[i];
        out->rate[i] = s->rate[i] + h * e->acceleration[i];
        out->integral[i] = s->integral[i] + h * e->error[i];
    }
    for (int i = 0; i < N && elastic(c->p); i++) {
        out->motor[i] = s->motor[i] + h * slope_of->motor_rate[i];
        out->motor_rate[i] = s->motor_rate[i] + h * e->motor_acceleration[i];
    }
}

/* One classical Runge-Kutta step with fixed modes; stage 0 must hold the evaluation at s. Stages stay in the context. */
static int rk4(context *c, const state *s, double t, double h, state *out) {
    static const double fraction[4] = {0, 0.5, 0.5, 1}, weight[4] = {1 / 6.0, 1 / 3.0, 1 / 3.0, 1 / 6.0};
    c->stage_state[0] = *s;
    c->stage_time[0] = t;
    for (int k = 1; k < 4; k++) {
        moved(c, s, &c->stage_state[k - 1], &c->stage[k - 1], fraction[k] * h, &c->stage_state[k]);
        c->stage_time[k] = t + fraction[k] * h;
        int status = evaluate(c, &c->stage_state[k], c->stage_time[k], &c->stage[k]);
        if (status != OK) return status;
    }
    *out = *s;
    for (int k = 0; k < 4; k++)
        moved(c, out, &c->stage_state[k], &c->stage[k], weight[k] * h, out);
    return OK;
}

/* Take the velocities of the joints in the list out of the pose rate, as an impulse would. */
static void stop_joints(context *c, evaluation *e, state *s, const int *list, int count) {
    if (elastic(c->p)) {
        for (int k = 0; k < count; k++) s->motor_rate[list[k]] = 0;
        return;
    }
    if (!count) return;
    if (count == N) {
        memset(s->rate, 0, sizeof s->rate);
        memset(c->x.v, 0, sizeof c->x.v);
        return;
    }
    vec impulse, change = {0};
    evaluate_compliance(e, list, count);
    for (int k = 0; k < count; k++) impulse[k] = dot_row(e->jacobian, list[k], s->rate);
    solve_stuck(e->compliance, list, count, impulse);
    for (int k = 0; k < count; k++)
        for (int j = 0; j < N; j++) change[j] -= e->inverse_rows[list[k]][j] * impulse[k];
    for (int j = 0; j < N; j++) s->rate[j] += change[j];
    if (c->p->sensitivities) stop_tangent(c, e, s, list, count, change, impulse);
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

/* By how much to weigh down the end of the bracket that stayed, when the other end moved twice. */
static double kept_share(double margin, double before) {
    double share = 1 - margin / before;
    return share > 0 ? share : 0.5;
}

/* The step in (0, h] at which the modes stop holding, to rounding: regula falsi (Anderson-Bjorck) on the margin. A joint that
 * has just started from rest has no margin yet: then the bracket is found by halving; *held tells whether there is one. */
static int locate_event(context *c, const state *s, double t, double h, double margin_at_h, double *step, state *out,
                        evaluation *end, int *held) {
    int joint, side = 0, status;
    double low = 0, high = h, at_high = margin_at_h, at_low = mode_margin(c, &c->stage[0], &joint), margin, tried = -1;
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
        tried = middle;
        if (margin <= 0) {
            if (side < 0) at_low *= kept_share(margin, at_high);
            high = middle; at_high = margin;
            if (margin == 0) break;
            side = -1;
        } else {
            if (side > 0) at_high *= kept_share(margin, at_low);
            low = middle; at_low = margin;
            side = 1;
        }
    }
    *step = high;
    return high == tried ? OK : trial_margin(c, s, t, high, out, end, &margin);
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
    c->mode[joint] = 0;
    count = stuck_joints(c->mode, list);
    stop_joints(c, end, s, list, count);
    int status = evaluate_terms(c, s, t, end);
    if (status != OK) return status;
    if (held) decide_modes(c, end, list, count);
    return evaluate(c, s, t, &c->stage[0]);
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
    if (status == OK && c->start_moves) rest_tangent(c, &c->stage[0], s, list, stuck_joints(c->mode, list));
    c->start_moves = 0;
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
            if (c->p->sensitivities) step_tangent(c, h, event, event && held, &end, &next, t + h);
            *s = next;
            t = event ? t + h : target;
            if (event) status = handle_event(c, s, t, &end, held);
            else {
                stop_joints(c, &end, s, list, stuck_joints(c->mode, list));
                for (int i = 0; i < N; i++)
                    if (!needs_event(c->p, i)) c->mode[i] = end.velocity[i] < 0 ? -1 : 1;
                status = evaluate(c, s, t, &c->stage[0]);
            }
        }
    }
    return status;
}
