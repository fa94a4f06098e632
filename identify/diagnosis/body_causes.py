"""Causes in bodies and joints: centres of mass, products of inertia, passive and uneven friction.

Each cause is a torque that the joints need in addition to the torques of the model. Torques of
bodies are columns of the regressor of full bodies (ten inertial parameters each), along the motion
of the model. Torques of passive joints are columns of `dynamics.rigid_body.passive_friction`. All
act on the model as changes of its commands (`identify.model.joint_torques`). The drives already
hold these torques before the motion begins, so that only the change from their first value acts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun
from dynamics.closed_loop.drives import READS
from dynamics.geometry import RobotGeometry
from dynamics.parameter_units import of_all_legs
from dynamics.parameters import passive_parameters
from dynamics.spatial_inertia import FIRST_MOMENTS, PRODUCTS
from identify.arrays import Array
from identify.diagnosis.cause import Cause, Change, InList, OnTorques, prior_std
from identify.estimation.output_error_problem import OutputErrorProblem
from identify.model.body_torques import (
    RunMotion,
    body_wrenches,
    by_the_joints,
    passive_columns,
    run_motion,
)
from identify.model.loop_model import LoopModel
from identify.record.stored_common_errors import FRICTION_OFFSET

PASSIVE_GROUP = "friction of passive joints"  # group of the friction of passive joints
MOVING = 0.01  # fraction of its RMS velocity above which a joint counts as moving
# Smallest standard deviation, N m or N, of an offset of friction that a remedy states.
LEAST_OFFSET = 0.01


@dataclass(frozen=True)
class Needed:
    """Additional torques that the joints need for a cause of size one, with attributes of `Cause`.

    torques: one array (N, n) for each run, N m or N. along: function that returns these torques for
    other motions of the runs. None: a fit keeps those along the first motion.
    """

    name: str
    unit: str
    group: str
    torques: tuple[Array, ...]
    remedy: str | InList | Callable[[float], str]
    least: float = -np.inf
    along: Callable[[Sequence[RunMotion]], tuple[Array, ...]] | None = None


def body_causes(
    problem: OutputErrorProblem, parameters: Array, runs: Sequence[ClosedLoopRun]
) -> tuple[Cause, ...]:
    """Return the causes in bodies and joints of a problem at its optimum (p,).

    runs: the model's simulated run for each record.
    """
    motions = [run_motion(run, found) for run, found in zip(problem.runs, runs, strict=True)]
    needed = [
        *_uneven_bodies(problem.runs[0].robot, parameters, motions),
        *_passive_friction(problem.runs[0].robot, motions),
        *_uneven_friction(problem.runs[0], motions),
    ]
    return tuple(_cause(one) for one in needed)


def _cause(one: Needed) -> Cause:
    along = one.along

    def renewed(there: OutputErrorProblem, at: Array) -> Cause:
        assert along is not None
        motions = [run_motion(run, run.simulate(at)) for run in there.runs]
        return _cause(replace(one, torques=along(motions)))

    return Cause(
        name=one.name,
        unit=one.unit,
        group=one.group,
        change=_added(one),
        step=1.0,
        remedy=_remedy(one.remedy),
        least=one.least,
        effect=OnTorques(one.torques),
        renewed=None if along is None else renewed,
    )


def _remedy(
    remedy: str | InList | Callable[[float], str],
) -> Callable[[float], str] | InList:
    """Return the remedy of a cause. A text becomes a function that ignores the size."""
    return (lambda size: remedy) if isinstance(remedy, str) else remedy


def _added(one: Needed) -> Change:
    """Return the change of a problem whose joints need further torques."""

    def added(problem: OutputErrorProblem, size: float) -> OutputErrorProblem:
        runs = [
            run.with_torques(size * torques)
            for run, torques in zip(problem.runs, one.torques, strict=True)
        ]
        return replace(problem, runs=tuple(runs))

    return added


def _uneven_bodies(robot: Robot, parameters: Array, motions: Sequence[RunMotion]) -> list[Needed]:
    """Return torques for offset centres of mass and products of inertia of platform and leg bodies.

    All bodies of one kind have the same offset or product, each in its own axes. Full bodies are
    left out, as the model has these parameters.
    """
    layout = robot.layout
    masses = layout.bodies_of(parameters[layout.rigid])[:, 0]
    needed = []
    together = []
    weights = []
    for kind in dict.fromkeys(one.name for one in layout.kinds):
        bodies = [
            index
            for index, one in enumerate(layout.kinds)
            if one.name == kind and not layout.full[index]
        ]
        if not bodies:
            continue
        words = "the platform" if kind == "platform" else f"the {kind}s"
        # this key leaves the settings of other kinds of bodies as they are
        remedy = f"--set model.inertia.{kind}=full"
        if kind == "platform":
            remedy += ", or state a load that is on it"
        for names, unit, group in (
            (FIRST_MOMENTS, "m", f"centre of mass of {words}"),
            (PRODUCTS, "kg m2", f"products of inertia of {words}"),
        ):
            for name in names:
                together.append(tuple(f"{layout.bodies[index]}.{name}" for index in bodies))
                weights.append(masses[bodies] if unit == "m" else np.ones(len(bodies)))
                axis = name[-1] if unit == "m" else name
                needed.append(Needed(f"{group}, {axis}", unit, group, (), remedy))
    wrenches = [body_wrenches(robot.geometry, one, tuple(together), weights) for one in motions]
    return [
        replace(one, torques=_at_the_joints(motions, wrenches, index))
        for index, one in enumerate(needed)
    ]


def _passive_friction(robot: Robot, motions: Sequence[RunMotion]) -> list[Needed]:
    """Return torques for viscous and dry friction of the passive joints, the same in all legs.

    Parameters that the model has are left out.
    """
    geometry = robot.geometry
    names = passive_parameters(geometry.legs)
    modelled = {of_all_legs(one) for one in robot.layout.passive_names}
    columns = [passive_columns(geometry, one) for one in motions]
    needed = []
    for index, name in enumerate(names):
        if name in modelled:
            continue
        needed.append(
            Needed(
                name=passive_words(name),
                unit=robot.layout.unit(name),
                group=PASSIVE_GROUP,
                torques=_at_the_joints(motions, columns, index),
                remedy=InList("model.passive_friction", robot.layout.passive_names, name),
                least=0.0,
                along=partial(_passive_torques, geometry, index),
            )
        )
    return needed


def _passive_torques(
    geometry: RobotGeometry, place: int, motions: Sequence[RunMotion]
) -> tuple[Array, ...]:
    """Return torques along motions for the parameter of passive friction with the index `place`."""
    return _at_the_joints(motions, [passive_columns(geometry, one) for one in motions], place)


def _at_the_joints(
    motions: Sequence[RunMotion], columns: Sequence[Array], place: int
) -> tuple[Array, ...]:
    """Return the torques (N, n) for the column `place` of wrenches (N, 6, k), along each motion."""
    pairs = zip(motions, columns, strict=True)
    return tuple(by_the_joints(one, wrenches[:, :, place]) for one, wrenches in pairs)


def passive_words(name: str) -> str:
    """Return the words for a parameter of passive friction."""
    joint, law = name.split(".")
    kind = "dry" if law == "coulomb" else law
    return f"{kind} friction of the {joint.replace('_', ' ')}s"


def _uneven_friction(run: LoopModel, motions: Sequence[RunMotion]) -> list[Needed]:
    """Return torques for half the difference of each joint's dry friction between both directions.

    The result is empty where the model estimates such offsets.
    """
    layout = run.robot.layout
    if any(name.startswith(FRICTION_OFFSET) for name in run.common.loop_std):
        return []
    unit = layout.unit("joint1.coulomb")
    key = f"model.friction_offset_std_{unit.replace(' ', '_')}"
    integrates = "li" in READS[run.settings.drives.law]

    def remedy(size: float) -> str:
        if integrates:
            return f"--set {key}={prior_std(size, LEAST_OFFSET):g}"
        return (
            "state how well the zeros of the joints are known: with this law of the drives, an "
            "offset of friction acts like an error of a zero"
        )

    rates = [one.joint_rates for one in motions]
    typical = np.sqrt(np.mean(np.concatenate(rates) ** 2, axis=0))
    moving = [np.abs(rate) > MOVING * typical for rate in rates]
    return [
        Needed(
            f"dry friction of joint {joint + 1} that differs with direction",
            unit,
            "friction that differs with direction",
            tuple(np.where(one, np.eye(layout.joints)[joint], 0.0) for one in moving),
            remedy,
        )
        for joint in range(layout.joints)
    ]
