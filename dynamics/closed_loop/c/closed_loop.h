/* Constants and types of the compiled closed loop: the twin of plain_loop.py, stick_slip.py, sensitivity.py
 * and servo.py, which explain the method and are tested to be equal. After this file come, in one unit with the C
 * code that CasADi generates for equation_of_motion, motion_derivatives and rate_map_derivative (column-major matrices):
 * linear_algebra.c, joint_friction.c, elastic_joints.c, joint_modes.c, step_sensitivity.c, stick_slip.c, visual_servo.c,
 * closed_loop.c.
 */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define N 6
#define NRIGID 52
#define NP 67
#define LENGTH 67 /* the column of the step's length */
#define START 68  /* the columns of the start state: pose, pose rate, joint PID integral, servo integral */
#define NSTART 24
#define WIDTH 92  /* without the start state the first 68 columns are used: both are multiples of 4 */
#define NSTATE 18
#define COULOMB 52
#define VISCOUS 58
#define LP 64
#define LI 65
#define LD 66
#define MAX_EVENTS_PER_SEGMENT 400
#define MAX_DELAY 64
#define NO_MARGIN 1e-12  /* rad/s, or share of the breakaway torque */
#define NO_APPROACH 1e-9 /* rad/s^2 or N m/s: an event so slow has no derivative */

enum { COULOMB_VISCOUS = 0, SMOOTHED = 1, STRIBECK = 2 };
enum { OK = 0, LEFT_REACH = 1, TOO_MANY_EVENTS = 2, SENSOR_FAILED = 3, OUT_OF_MEMORY = 4, MEASURED_OUT_OF_REACH = 5,
       SINGULAR_MASS = 6 };
enum { SENSOR_RAISED = 0, MEASURED = 1, LOST = 2 }; /* what the sensor returns */

typedef double vec[N];
typedef double row[WIDTH];
typedef row rows[N];

/* What CasADi generates for a function, and for the sizes of its work arrays. */
typedef int (*motion_fn)(const double **arg, double **res, casadi_int *iw, double *w, int mem);
typedef int (*work_fn)(casadi_int *arg, casadi_int *res, casadi_int *iw, casadi_int *w);

typedef struct {
    int frames, law, sensitivities, start_sensitivities, commands_before;
    double frame_period, smoothing_velocity, static_level, stribeck_velocity;
    double rigid[NRIGID];
    vec coulomb, viscous;
    double lp, li, ld, kp, kd, ki;
    double stiffness, damping, motor_inertia; /* of elastic joints; a stiffness of 0: rigid */
    vec motor, motor_rate;
    vec pose, rate, integral, servo_integral, last_measured;
    const double *start_commands;       /* (commands_before, 6), oldest first; the first also acted earlier */
    const double *integral_sensitivity; /* (6, NP) or NULL */
    const double *reference;            /* (frames, 6) */
    const double *reference_rate;       /* (frames, 6) */
    const double *logged_commands;      /* (frames, 6), or NULL: the servo computes them */
    const signed char *lost;            /* (frames) 1 where the ideal sensor measures nothing, or NULL */
    const double *noise;                /* (frames, 6) added to what the ideal sensor measures, or NULL */
    const int *first_span, *span_command, *span_steps; /* which command acts when: see command_schedule.py */
    const double *span_ramp, *span_duration;
    motion_fn servo_motion; /* equation of motion of the robot that the servo knows, or NULL: of this one */
    work_fn servo_motion_work;
} problem;

typedef struct {
    double *pose, *rate, *torque, *command, *measured, *integral, *servo_integral; /* (frames, 6) */
    signed char *measured_ok;                          /* (frames) */
    double *pose_sensitivity;                          /* (frames, 6, NP) or NULL */
    double *start_sensitivity;                         /* (frames, 6, NSTART) or NULL */
    double *end_sensitivity, *end_start_sensitivity;   /* (NSTART, NP) and (NSTART, NSTART), or NULL */
    double *motor, *motor_rate;                        /* (frames, 6) of elastic joints or NULL */
    int events, failed_frame;
    vec last_pose;                                     /* the last at which the equation of motion was evaluated */
} trajectory;

typedef int (*measure_fn)(int frame, const double *pose, const double *rate, double *measured);

typedef struct { vec pose, rate, integral, motor, motor_rate; } state; /* the last two: of elastic joints */

typedef struct { vec value, slope, rate; } command; /* U(t) = value + slope t; U_dot as the joint PID sees it */

typedef double factor[N][N]; /* Cholesky factor L, with the reciprocals of its diagonal */

typedef struct {
    double jacobian[N * N];
    factor cholesky;           /* of the mass matrix */
    vec bias, bias_acceleration, angle, velocity;
    vec error;                 /* from here on: more than a function of pose and pose rate */
    vec torque, net_torque, stick_force, acceleration;
    vec spring, motor_acceleration; /* of elastic joints, for which angle and velocity are those of the motors */
    vec inverse_rows[N];       /* M^-1 J^T, column i for joint i */
    double compliance[N][N];   /* J M^-1 J^T */
} evaluation;

/* Derivatives of a state. */
typedef union {
    row all[NSTATE];
    struct { rows q, v, z; };
} tangent;

typedef struct {
    const problem *p;
    int mode[N]; /* 0: stuck, +1 or -1: slipping that way */
    vec known_pose, known_rate; /* where the equation of motion was evaluated last */
    evaluation known;           /* what it gave there, up to `error`, if `knows` */
    int knows;
    command u;
    int ramping;                /* whether its slope is not zero */
    rows du_value, du_slope, du_rate;
    state stage_state[4];
    evaluation stage[4];
    double stage_time[4];
    int width;              /* columns of the sensitivities in use */
    tangent x, k[4], trial;
    row d_time, d_length;   /* of the time at which the present step starts, and of its length */
    int time_moves, length_moves; /* whether they are not zero */
    int start_moves;        /* until the modes of the start are decided */
    int events;
    const double **arg;
    double **res;
    casadi_int *iw;
    double *w;
} context;
