/* The frame loop: see plain_loop.py. */

static int frame_command(context *c, servo *v, int k, const state *s, measure_fn measure, trajectory *out) {
    const problem *p = c->p;
    double measured[N];
    int good = 1;
    memcpy(measured, s->pose, sizeof measured);
    if (measure) {
        int answer = measure(k, s->pose, s->rate, measured);
        if (answer != MEASURED && answer != LOST) return SENSOR_FAILED;
        good = answer == MEASURED;
    } else if (p->lost && p->lost[k]) {
        good = 0;
        for (int i = 0; i < N; i++) measured[i] = NAN;
    } else if (p->noise) {
        for (int i = 0; i < N; i++) measured[i] += p->noise[N * k + i];
    }
    v->elapsed += p->frame_period;
    memcpy(out->measured + N * k, measured, sizeof measured);
    out->measured_ok[k] = (signed char)good;
    if (p->logged_commands)
        memcpy(v->last_command, p->logged_commands + N * k, sizeof(vec));
    else if (good)
        servo_update(c, v, k, measured);
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

static void record_sensitivities(const context *c, int k, trajectory *out) {
    for (int i = 0; i < N; i++) {
        size_t row = (size_t)N * k + i;
        if (out->pose_sensitivity) memcpy(out->pose_sensitivity + NP * row, c->x.q[i], NP * sizeof(double));
        if (out->start_sensitivity)
            memcpy(out->start_sensitivity + NSTART * row, c->x.q[i] + START, NSTART * sizeof(double));
    }
}

/* The state of a frame that is not yet measured: pose, pose rate, joint PID integral, servo integral. */
static void record_end(const context *c, const servo *v, trajectory *out) {
    for (int i = 0; i < NSTART; i++) {
        const double *entry = i < NSTATE ? c->x.all[i] : v->d_integral[i - NSTATE];
        if (out->end_sensitivity) memcpy(out->end_sensitivity + NP * i, entry, NP * sizeof(double));
        if (out->end_start_sensitivity)
            memcpy(out->end_start_sensitivity + NSTART * i, entry + START, NSTART * sizeof(double));
    }
}

static int run_frames(context *c, servo *v, issued *ring, state *s, measure_fn measure, trajectory *out) {
    const problem *p = c->p;
    int status = OK;
    for (int k = 0; k < p->frames; k++) {
        out->failed_frame = k;
        memcpy(out->pose + N * k, s->pose, sizeof(vec));
        memcpy(out->rate + N * k, s->rate, sizeof(vec));
        memcpy(out->integral + N * k, s->integral, sizeof(vec));
        memcpy(out->servo_integral + N * k, v->integral, sizeof(vec));
        if (out->motor) memcpy(out->motor + N * k, s->motor, sizeof(vec));
        if (out->motor_rate) memcpy(out->motor_rate + N * k, s->motor_rate, sizeof(vec));
        record_sensitivities(c, k, out);
        if (k + 1 == p->frames) record_end(c, v, out);
        status = frame_command(c, v, k, s, measure, out);
        if (status != OK) return status;
        issued *slot = &ring[k % MAX_DELAY];
        memcpy(slot->value, v->last_command, sizeof(vec));
        if (p->sensitivities) memcpy(slot->tangent, v->d_command, sizeof(rows));
        for (int n = p->first_span[k]; n < p->first_span[k + 1]; n++) {
            apply_command(c, ring, p->span_command[n], p->span_ramp[n]);
            if (n == p->first_span[k]) status = record_torque(c, s, out->torque + N * k);
            if (status != OK) return status;
            if (k + 1 == p->frames) break;
            status = segment(c, s, p->span_duration[n], p->span_steps[n]);
            if (status != OK) return status;
        }
    }
    out->failed_frame = -1;
    return OK;
}

static casadi_int largest(casadi_int a, casadi_int b) { return a > b ? a : b; }

static int allocate_work(context *c) {
    const work_fn sizes[] = {equation_of_motion_work, motion_derivatives_work, rate_map_derivative_work,
                             c->p->servo_motion_work};
    casadi_int arg = 0, res = 0, iw = 0, w = 0, a, r, i, n;
    for (size_t k = 0; k < sizeof sizes / sizeof *sizes; k++) {
        if (!sizes[k]) continue;
        sizes[k](&a, &r, &i, &n);
        arg = largest(arg, a); res = largest(res, r); iw = largest(iw, i); w = largest(w, n);
    }
    c->arg = calloc((size_t)arg + 1, sizeof *c->arg);
    c->res = calloc((size_t)res + 1, sizeof *c->res);
    c->iw = calloc((size_t)iw + 1, sizeof *c->iw);
    c->w = calloc((size_t)w + 1, sizeof *c->w);
    return c->arg && c->res && c->iw && c->w;
}

/* State, modes, servo and commands at frame 0. Joints slower than NO_MARGIN are at rest. */
static void begin(context *c, servo *v, issued *ring, state *s) {
    const problem *p = c->p;
    memcpy(s->pose, p->pose, sizeof(vec));
    memcpy(s->rate, p->rate, sizeof(vec));
    memcpy(s->integral, p->integral, sizeof(vec));
    memcpy(s->motor, p->motor, sizeof(vec));
    memcpy(s->motor_rate, p->motor_rate, sizeof(vec));
    memcpy(v->integral, p->servo_integral, sizeof(vec));
    memcpy(v->previous_measured, p->last_measured, sizeof(vec));
    memcpy(v->last_command, p->start_commands + N * (p->commands_before - 1), sizeof(vec));
    for (int k = 1; k <= MAX_DELAY; k++) {
        int number = p->commands_before > k ? p->commands_before - k : 0;
        memcpy(ring[MAX_DELAY - k].value, p->start_commands + N * number, sizeof(vec));
    }
    int status = evaluate_terms(c, s, 0, &c->stage[0]); /* where it fails, the first frame does and says so */
    for (int i = 0; i < N && status == OK; i++) {
        double velocity = c->stage[0].velocity[i];
        c->mode[i] = fabs(velocity) <= NO_MARGIN ? 0 : velocity > 0 ? 1 : -1;
    }
    if (!p->sensitivities) return;
    c->start_moves = p->start_sensitivities;
    c->width = p->start_sensitivities ? WIDTH : START;
    for (int i = 0; i < N; i++) {
        if (p->integral_sensitivity) memcpy(c->x.z[i], p->integral_sensitivity + NP * i, NP * sizeof(double));
        if (!p->start_sensitivities) continue;
        c->x.q[i][START + i] = c->x.v[i][START + N + i] = 1;
        c->x.z[i][START + 2 * N + i] = v->d_integral[i][START + 3 * N + i] = 1;
    }
}

CASADI_SYMBOL_EXPORT int closed_loop_run(const problem *p, measure_fn measure, trajectory *out) {
    context *c = calloc(1, sizeof *c);
    servo *v = calloc(1, sizeof *v);
    issued *ring = calloc(MAX_DELAY, sizeof *ring);
    int status = OUT_OF_MEMORY;
    if (c) c->p = p;
    if (c && v && ring && allocate_work(c)) {
        state s;
        begin(c, v, ring, &s);
        status = run_frames(c, v, ring, &s, measure, out);
        out->events = c->events;
        memcpy(out->last_pose, c->known_pose, sizeof(vec));
    }
    if (c) { free((void *)c->arg); free(c->res); free(c->iw); free(c->w); }
    free(c); free(v); free(ring);
    return status;
}
