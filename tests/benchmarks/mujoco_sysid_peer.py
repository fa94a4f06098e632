"""The same identification by `mujoco.sysid`, set up as in its own tests: a modifier a parameter,
its default optimizer, its normalisation of residuals, its intervals.

MuJoCo steps with the 1 ms of the record, semi-implicitly (`implicitfast`) or, at four times the
cost, by RK4. What is compared is its state (the free joint of the platform): a sensor of MuJoCo
would show the state before the last step.
"""

import time

import mujoco
import numpy as np
from mujoco import rollout, sysid
from mujoco.sysid import Parameter, ParameterDict, SignalType, TimeSeries

from dynamics.engines.mjcf import MjcfSolver, mjcf_text
from tests.benchmarks import servo_experiment as servo

BOUNDS = 0.05, 5.0  # of each parameter, as shares of the truth; the optimizer wants finite ones
# Position and quaternion of the platform in MuJoCo's state, which begins with the time.
PLATFORM = slice(1, 8)


def model_spec(integrator="implicitfast"):
    """rss6 as an editable model of MuJoCo, its motors turned into servos that damp the joints'
    rates.
    """
    solver = MjcfSolver(timestep_s=1 / servo.RATE_HZ, integrator=integrator)
    spec = mujoco.MjSpec.from_string(
        mjcf_text(
            servo.robot(),
            servo.table()[:64],
            allow_unphysical_inertia=True,
            solver=solver,
            source="true parameters",
        )
    )
    lp, ld = servo.servo_gains()
    for leg in range(1, 7):
        motor = spec.actuator(f"motor{leg}")
        motor.gainprm[0] = lp
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.biasprm[:3] = [0.0, -lp, -ld]
    return spec


def simulated_poses(commands):
    """Poses (frames, 6) of the true robot in MuJoCo's simulation with the estimator's own
    settings."""
    model = model_spec().compile()
    state, _ = rollout.rollout(
        model, mujoco.MjData(model), at_home(model), servo.felt_commands(commands)[:-1]
    )
    states = np.vstack([at_home(model), state[0]])[:, PLATFORM]
    return servo.Measured(states[:, :3], states[:, 3:]).pose


def estimate(commands, measured, guess, integrator="implicitfast"):
    """The 14 unknowns from commands (frames, 6), what was `Measured`, and a first guess (14,)."""
    spec, free = model_spec(integrator), unknowns(guess)
    seen = np.hstack([measured.position, measured.quaternion])
    signal = TimeSeries.from_custom_map(
        servo.TIMES, seen, [("platform_qpos", 7, SignalType.MjStateQPos)]
    )
    sequences = sysid.ModelSequences(
        "rss6",
        spec,
        "run",
        at_home(spec.compile()),
        TimeSeries(servo.TIMES, servo.felt_commands(commands)),
        signal,
        allow_missing_sensors=True,
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    began = time.perf_counter()
    found, result = sysid.optimize(initial_params=free, residual_fn=residual, verbose=False)
    _, half_widths = sysid.calculate_intervals(residual(result.x, found)[0], result.jac)
    return servo.Estimate(found.as_vector(), half_widths, time.perf_counter() - began)


def at_home(model):
    """State of rest at home."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return sysid.create_initial_state(model, data.qpos, data.qvel, data.act)


def unknowns(guess):
    """The 14 unknowns as `mujoco.sysid` wants them, at a first guess (14,)."""
    moments = servo.table()[1:4].copy()

    def mass(spec, found):
        spec.body("platform").mass = found.value[0]

    def inertia(spec, found):
        spec.body("platform").inertia = moments * found.value[0]

    def coulomb(leg):
        return lambda spec, found: setattr(
            spec.joint(f"joint{leg}"), "frictionloss", found.value[0]
        )

    def viscous(leg):
        return lambda spec, found: spec.joint(f"joint{leg}").damping.__setitem__(0, found.value[0])

    modifiers = [mass, inertia, *map(coulomb, range(1, 7)), *map(viscous, range(1, 7))]
    free = ParameterDict()
    for place, (modifier, value) in enumerate(zip(modifiers, servo.truth(), strict=True)):
        lower, upper = (share * value for share in BOUNDS)
        free.add(Parameter(f"p{place}", guess[place], lower, upper, modifier=modifier))
    return free
