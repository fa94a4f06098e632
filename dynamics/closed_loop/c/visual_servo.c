/* The visual servo (eq. 30) and the commands on their way to the joints: see servo.py and plain_loop.py. */

typedef struct {
    vec previous_measured, integral, last_command;
    rows d_previous, d_integral, d_command;
    double elapsed;
} servo;

/* Visual servo, eq. 30, at one good frame: command and its sensitivities. */
static void servo_update(context *c, servo *v, int k, const double *measured) {
    const problem *p = c->p;
    const double period = p->frame_period;
    vec demand;
    double jacobian[N * N];
    for (int i = 0; i < N; i++) {
        double error = p->reference[N * k + i] - measured[i];
        double rate = (measured[i] - v->previous_measured[i]) / v->elapsed;
        v->integral[i] += period * error;
        demand[i] = p->kp * error + p->kd * (p->reference_rate[N * k + i] - rate) + p->ki * v->integral[i];
    }
    pose_jacobian(c, measured, jacobian);
    for (int i = 0; i < N; i++) v->last_command[i] = dot_row(jacobian, i, demand);
    if (p->sensitivities) {
        double by_pose[N * N];
        rows d_demand;
        c->arg[0] = measured; c->arg[1] = demand;
        c->res[0] = by_pose;
        rate_map_derivative(c->arg, c->res, c->iw, c->w, 0);
        for (int i = 0; i < N; i++)
            for (int n = 0; n < c->width; n++) {
                double d = c->x.q[i][n];
                double d_rate = (d - v->d_previous[i][n]) / v->elapsed;
                v->d_integral[i][n] -= period * d;
                d_demand[i][n] = -p->kp * d - p->kd * d_rate + p->ki * v->d_integral[i][n];
                v->d_previous[i][n] = d;
            }
        memset(v->d_command, 0, sizeof v->d_command);
        multiply_add(c, 1, jacobian, d_demand, v->d_command);
        multiply_add(c, 1, by_pose, v->d_previous, v->d_command);
    }
    memcpy(v->previous_measured, measured, sizeof(vec));
    v->elapsed = 0;
}

typedef struct { vec value; rows tangent; } issued; /* a command on its way to the joint controllers */

/* Let command number `newest` act, when a share of the way from the one before it is done: 1 is all of it. */
static void apply_command(context *c, const issued *ring, int newest, double ramp) {
    const problem *p = c->p;
    const issued *now = &ring[(newest + MAX_DELAY) % MAX_DELAY], *before = &ring[(newest + MAX_DELAY - 1) % MAX_DELAY];
    c->ramping = ramp < 1;
    for (int i = 0; i < N; i++) {
        c->u.rate[i] = (now->value[i] - before->value[i]) / p->frame_period;
        c->u.value[i] = c->ramping ? before->value[i] + ramp * (now->value[i] - before->value[i]) : now->value[i];
        c->u.slope[i] = c->ramping ? c->u.rate[i] : 0;
        for (int k = 0; k < c->width; k++) {
            c->du_rate[i][k] = (now->tangent[i][k] - before->tangent[i][k]) / p->frame_period;
            double d_step = now->tangent[i][k] - before->tangent[i][k];
            c->du_value[i][k] = c->ramping ? before->tangent[i][k] + ramp * d_step : now->tangent[i][k];
            c->du_slope[i][k] = c->ramping ? c->du_rate[i][k] : 0;
        }
    }
}
