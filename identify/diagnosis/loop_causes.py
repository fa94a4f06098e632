"""Causes in the loop around the robot: friction, gains, springs, limits and laws of drives, steps.

Many of them show nothing at a small size, or are there or not. They are asked at trial sizes. These
are taken from the run of the model itself: velocities from those of its joints, limits from its
torques.

A joint that is driven through a spring lags behind its motor by the torque over the stiffness. To
first order that is a shift of its command.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dynamics.closed_loop import ClosedLoopRun, FrictionLaw, LoopSettings
from dynamics.closed_loop.drives import READS, DriveName
from dynamics.parameters import JOINT_PID
from identify.arrays import Array
from identify.diagnosis.cause import Cause, Change, OnCommands, OnGain, in_each_run
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.filtering import interpolated
from identify.model.body_torques import joint_rates
from identify.model.loop_model import LoopModel
from identify.model.timed_model import TimedModel
from identify.model.unequal_gains import with_unequal_gains

# Velocities over which static friction fades, as fractions of the joints' RMS velocity.
SLOW = {"slow": 0.1, "middling": 0.3, "fast": 0.9}
FRICTION = "law of friction"  # group of the laws of friction, of which a joint has one
FINER = 4  # ratio of the steps per frame of the finer model to those of the model
# Deflection at the largest torque that is the step of differences, by unit of the joints.
DEFLECTION = {"rad": 1e-4, "m": 1e-5}
GAIN_STEP = 1e-3  # relative change of a gain for differences
LEAST_GAIN = -0.9  # least relative difference of a gain, as a law needs gains above zero


def loop_causes(
    problem: OutputErrorProblem, parameters: Array, runs: Sequence[ClosedLoopRun]
) -> tuple[Cause, ...]:
    """Return the causes in the loop of a problem at its optimum (p,). runs: those of the model."""
    rates = [joint_rates(run, found) for run, found in zip(problem.runs, runs, strict=True)]
    typical = float(np.sqrt(np.mean(np.concatenate(rates) ** 2)))
    peak = max(float(np.abs(found.torque).max()) for found in runs)
    return (
        *gain_causes(problem, parameters),
        *friction_causes(problem.runs[0], typical),
        elasticity(problem, parameters, runs, rates),
        torque_limit(problem.runs[0], peak),
        *laws(problem.runs[0].settings),
        finer_steps(problem.runs[0].settings),
    )


def in_settings(change: Callable[[LoopSettings, float], LoopSettings]) -> Change:
    """Return the change of a problem that changes the loop's settings of each of its runs."""
    return in_each_run(lambda run, size: replace(run, settings=change(run.settings, size)))


def friction_causes(run: LoopModel, typical: float) -> tuple[Cause, ...]:
    """Return other laws of friction, if the model has Coulomb and viscous friction.

    typical: RMS velocity of the joints.
    """
    if run.settings.friction.name != "coulomb_viscous":
        return ()
    unit = f"{run.robot.layout.joint_unit}/s"
    key = unit.replace("/", "_")

    def smoothed(settings: LoopSettings, size: float) -> LoopSettings:
        return replace(settings, friction=FrictionLaw("smoothed", smoothing_velocity=size))

    smooth = Cause(
        name="friction that is smooth about rest",
        unit=unit,
        group=FRICTION,
        change=in_settings(smoothed),
        step=2e-3 * typical,
        remedy=lambda size: (
            f"--set model.friction=smoothed --set model.smoothing_velocity_{key}={size:.6g}"
        ),
        least=5e-4 * typical,
        tried=(0.01 * typical, 0.05 * typical),
        exclusive=True,
    )
    static = (_static(name, share * typical, unit, key) for name, share in SLOW.items())
    return (*static, smooth)


def _static(name: str, velocity: float, unit: str, key: str) -> Cause:
    """Return static friction in excess of Coulomb friction, which fades over a velocity."""

    def stribeck(settings: LoopSettings, size: float) -> LoopSettings:
        law = FrictionLaw("stribeck", static_ratio=1.0 + size, stribeck_velocity=velocity)
        return replace(settings, friction=law)

    def faded(settings: LoopSettings, size: float) -> LoopSettings:
        if settings.friction.name != "stribeck":
            return settings
        law = replace(settings.friction, stribeck_velocity=velocity + size)
        return replace(settings, friction=law)

    width = Cause(
        name=f"velocity over which it fades, beyond {velocity:.3g} {unit}",
        unit=unit,
        group=f"width of static friction, {name}",
        change=in_settings(faded),
        step=0.05 * velocity,
        remedy=lambda size: (
            f"and --set model.stribeck_velocity_{key}={velocity + size:.6g} in place of that"
        ),
        least=-0.9 * velocity,
        alone=False,
    )
    return Cause(
        name=f"static friction, fading over {name} motion",
        unit="1",
        group=FRICTION,
        change=in_settings(stribeck),
        step=0.02,
        remedy=lambda size: (
            f"--set model.friction=stribeck --set model.static_ratio={1 + size:.6g} "
            f"--set model.stribeck_velocity_{key}={velocity:.6g}"
        ),
        least=0.0,
        exclusive=True,
        companion=width,
    )


def elasticity(
    problem: OutputErrorProblem,
    parameters: Array,
    runs: Sequence[ClosedLoopRun],
    rates: list[Array],
) -> Cause:
    """Return the compliance of the joints, the same for all, at an optimum (p,).

    runs and rates (N, n): each run of the model, and the velocities of its joints.
    """
    layout = problem.runs[0].robot.layout
    torque_unit = layout.unit("joint1.coulomb")
    carried = [
        _carried(run, parameters, found, rate)
        for run, found, rate in zip(problem.runs, runs, rates, strict=True)
    ]

    def deflected(changed: OutputErrorProblem, size: float) -> OutputErrorProblem:
        pairs = zip(changed.runs, carried, strict=True)
        return replace(
            changed, runs=tuple(replace(run, logged=run.logged - size * by) for run, by in pairs)
        )

    def along_the_motion(there: OutputErrorProblem, at: Array) -> Cause:
        moved = [run.simulate(at) for run in there.runs]
        speeds = [joint_rates(run, found) for run, found in zip(there.runs, moved, strict=True)]
        return elasticity(there, at, moved, speeds)

    peak = max(float(np.abs(one).max()) for one in carried)
    return Cause(
        name="elasticity of the joints",
        unit=f"{layout.joint_unit}/({torque_unit})",
        group="elasticity of the joints",
        change=deflected,
        step=DEFLECTION[layout.joint_unit] / peak,
        remedy=lambda size: (
            f"stiffen the joints, or measure angles behind their springs: the stiffness is "
            f"{1 / size:.3g} {torque_unit}/{layout.joint_unit}, and the model has rigid joints"
        ),
        least=0.0,
        effect=OnCommands(lambda run, place: -carried[place]),
        renewed=along_the_motion,
    )


def _carried(run: LoopModel, parameters: Array, found: ClosedLoopRun, rates: Array) -> Array:
    """Return joint torques (N, n) less friction, in the middle of the time each command acts."""
    _, coulomb, viscous, _ = run.robot.layout.split(parameters + run.payload)
    friction = run.settings.friction
    carried = found.torque - coulomb * friction.level(rates) - viscous * rates
    period = 1.0 / run.settings.timing.frame_rate_hz
    if isinstance(run, TimedModel):
        begin = run.acting_now
    else:
        late = run.stated_latencies if run.latencies is None else run.latencies
        begin = found.time + late
    return interpolated(begin + period / 2, found.time, carried)


def torque_limit(run: LoopModel, peak: float) -> Cause:
    """Return a limit of the torques below the largest torque `peak` of the model.

    The size is the fraction of `peak` that the limit cuts off. With other causes, the largest
    torque differs. Trial sizes are small, since motion can add only a few per cent to the weight.
    """
    layout = run.robot.layout
    unit = layout.unit("joint1.coulomb")
    key = unit.replace(" ", "_")

    def limited(settings: LoopSettings, size: float) -> LoopSettings:
        drives = replace(settings.drives, torque_limit=peak * (1.0 - min(size, 0.99)))
        return replace(settings, drives=drives)

    def anew(there: OutputErrorProblem, at: Array) -> Cause:
        torques = [np.abs(one.simulate(at).torque).max() for one in there.runs]
        return torque_limit(run, float(max(torques)))

    return Cause(
        name="torque limit of the drives",
        unit="1",
        group="torque limit of the drives",
        change=in_settings(limited),
        step=2e-4,
        remedy=lambda size: (
            f"look up the limit of the drives, and state it with the record as "
            f"control.torque_limit_{key}: in this model's scale it is {peak * (1 - size):.4g}"
        ),
        least=0.0,
        tried=(0.003, 0.01, 0.03, 0.1),
        anew=anew,
    )


def laws(settings: LoopSettings) -> tuple[Cause, ...]:
    """Return the other of the cascade and PID laws, which read the same gains, or no cause."""
    others: dict[str, DriveName] = {"pid": "cascade", "cascade": "pid"}
    other = others.get(settings.drives.law)
    if other is None:
        return ()

    def law(settings: LoopSettings, size: float) -> LoopSettings:
        return replace(settings, drives=replace(settings.drives, law=other))

    def under_it(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        changed = in_settings(law)(problem, size)
        # the guess tells which gains this law needs above zero
        return replace(changed, guess=replace(problem.guess, drive=other))

    return (
        Cause(
            name=f"drives of the law {other}",
            unit="",
            group="law of the drives",
            change=under_it,
            step=0.0,
            remedy=lambda size: f"--set model.drive={other}, or --set model.drive=auto",
            tried=(1.0,),
        ),
    )


def finer_steps(settings: LoopSettings) -> Cause:
    """Return the cause that the steps of the model are too coarse."""
    steps = FINER * settings.steps_per_frame

    def finer(settings: LoopSettings, size: float) -> LoopSettings:
        return replace(settings, steps_per_frame=steps)

    return Cause(
        name="steps of the model that are too coarse",
        unit="",
        group="steps of the model",
        change=in_settings(finer),
        step=0.0,
        remedy=lambda size: f"--set model.steps_per_frame={steps}",
        tried=(1.0,),
    )


def gain_causes(problem: OutputErrorProblem, parameters: Array) -> tuple[Cause, ...]:
    """Return the gains that can differ from those of the first joint, at an optimum (p,).

    The model has the gains of the first joint. The result is empty if each joint has its own.
    """
    run = problem.runs[0]
    layout = run.robot.layout
    if layout.own_gains:
        return ()
    # the initial guess replaces a gain at its bound, as steps are relative to the gain
    gains = np.where(parameters > 0, parameters, problem.guess.values)[layout.joint_pid]
    return tuple(
        _gain_difference(joint, kind, float(gains[kind]), layout.unit(layout.joint_pid_names[kind]))
        for joint in range(1, layout.joints)
        for kind, name in enumerate(JOINT_PID)
        if name in READS[run.settings.drives.law] and gains[kind] > 0
    )


def _gain_difference(joint: int, kind: int, gain: float, unit: str) -> Cause:
    """Return the difference of a joint's gain from that of the first joint."""

    def changed(run: LoopModel, size: float) -> LoopModel:
        differences = np.zeros((run.robot.layout.joints, len(JOINT_PID)))
        differences[joint, kind] = size
        return with_unequal_gains(run, differences)

    return Cause(
        name=f"{JOINT_PID[kind]} of joint {joint + 1}, beyond that of joint 1",
        unit=unit,
        group="gains that differ between joints",
        change=in_each_run(changed),
        step=GAIN_STEP * gain,
        remedy=lambda size: "--set model.gains=each",
        least=LEAST_GAIN * gain,
        effect=OnGain(joint, kind),
        exact=True,
    )
