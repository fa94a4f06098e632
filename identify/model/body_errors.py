"""Errors of a model whose bodies and passive joints are simpler than those of the robot.

A model with centred bodies assumes centres of mass at their nominal places and products of inertia
of zero. A model without friction of passive joints lets them turn freely. Most deviations of a real
robot from such a model leave no residual, because wrong values of the parameters compensate them.
Their standard deviations are therefore stated, in the robot file or in the scenario. The deviations
are estimated as errors that all poses of a record have in common, and widen the intervals of the
parameters.

All bodies of a kind are made alike, and have the same error, each in its own axes. So do the
passive joints at the same place in all legs. The errors act as torques at the joints
(`body_torques`, `joint_torques`). Their effect on the poses is taken as linear.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dynamics import Robot
from dynamics.closed_loop import ClosedLoopRun, LoopSettings, Reference, equilibrium
from dynamics.parameter_units import of_all_legs
from dynamics.parameters import passive_parameters
from dynamics.spatial_inertia import FIRST_MOMENTS, PRODUCTS
from identify.arrays import Array
from identify.loop_parameters import check_parameter_set
from identify.model.body_torques import body_wrenches, passive_columns, run_motion
from identify.model.error_modes import differentiated
from identify.scenario import Model

if TYPE_CHECKING:
    from identify.model.loop_model import LoopModel

LEAST_COMMAND = 1e-10  # largest change of a command, rad, m, N m or N, that counts as zero


@dataclass(frozen=True)
class BodyError:
    """Error that all bodies of a kind, or the passive joints at one place, have in common.

    kind, name  Kind of the error in `identification.nuisances`, and name of the error. The name
                begins with the kind and ends with the unit.
    owners      Rows of the bodies in the layout of the robot. There are none for a passive joint.
    parameters  Parameters that the model takes as zero: one for each owner, or the friction of the
                joint.
    """

    kind: str
    name: str
    owners: tuple[int, ...]
    parameters: tuple[str, ...]


def body_error_stds(robot: Robot, model: Model, kinds: tuple[str, ...]) -> dict[str, float]:
    """Return the standard deviations of the errors of bodies and passive joints, of some kinds.

    They are those of the model or, if it states none, of the robot file. Errors that are assumed to
    be zero are left out. Raises the ScenarioError of `check_parameter_set`.
    """
    check_parameter_set(robot, model.start_parameters)
    in_file = robot.geometry.unstated
    pairs = {
        "centres": (model.centre_std, in_file.centre_std),
        "products": (model.product_std, in_file.product_std),
        "passive_friction": (model.passive_viscous_std_N_m_s_rad, in_file.passive_viscous_std),
    }
    stated = {kind: known if own is None else own for kind, (own, known) in pairs.items()}
    values = robot.parameter_sets[model.start_parameters].dynamic
    bodies = robot.layout.bodies_of(values[robot.layout.rigid])
    sizes = {
        "centres": bodies[:, 0] * robot.geometry.body_lengths,
        "products": bodies[:, 4:7].mean(axis=1),
    }
    stds = {}
    for one in _errors(robot):
        size = float(sizes[one.kind][list(one.owners)].mean()) if one.owners else 1.0
        if (std := stated[one.kind] * size) and one.kind in kinds:
            stds[one.name] = std
    return stds


def body_errors(run: "LoopModel", parameters: Array) -> Array | None:
    """Return the changes (k, N, n) of commands with the effect of each error of a run's bodies.

    The changes are for one standard deviation of each error, along the motion with parameters (p,).
    They are in rad or m, or in N m or N if the drives take torques. Without such errors, the result
    is None. Raises LoopFailure if the model is unstable.
    """
    if not run.common.body_std:
        return None
    torques = _torques(run, parameters, run.simulate(parameters))
    if run.settings.drives.torques:
        return -torques
    needed = run.commands_for(torques.transpose(1, 0, 2), run.drive_law(parameters))
    return -needed.transpose(1, 0, 2)


def body_modes(run: "LoopModel", parameters: Array) -> dict[int, Array | float]:
    """Return, by place of the error, the changes (N, 6) of a run's poses by its errors of bodies.

    One run is differentiated along the changes of the commands. If the drives take torques, only
    errors that need no torque are returned. parameters (p,): those of the run. Raises LoopFailure
    if the model is unstable.
    """
    if run.bodies is None:
        return {}
    first = len(run.errors_had) - len(run.bodies)
    # a crank about a vertical axis, for example, needs no torque for most of its errors
    moving = np.abs(run.bodies).max(axis=(1, 2)) >= LEAST_COMMAND
    found: dict[int, Array | float] = {first + int(k): 0.0 for k in np.flatnonzero(~moving)}
    if run.settings.drives.torques:
        return found
    made, changes = differentiated(run, parameters, run.bodies[moving].transpose(1, 2, 0))
    run.known_runs.add(parameters, made)
    places = first + np.flatnonzero(moving)
    return found | {int(place): changes[:, :, k] for k, place in enumerate(places)}


def fed_forward(
    run: "LoopModel", robot: Robot, parameters: Array, reference: Reference, loop: LoopSettings
) -> dict[str, Any]:
    """Return further arguments of `simulate_servo` that add the effect of a run's errors of bodies.

    The effect is added to the servo's commands. The servo begins at rest, as without the errors.
    Without errors, the result is empty.
    """
    change = run.body_commands
    if change is None:
        return {}
    at_rest = robot, parameters, reference.poses[0], loop.servo, run.robot
    return {"start": equilibrium(*at_rest, drives=loop.drives), "feedforward": change}


def _torques(run: "LoopModel", parameters: Array, found: ClosedLoopRun) -> Array:
    """Return the torques (k, N, n) that the joints need for one standard deviation of each error.

    found: run of the model at parameters (p,). Before the motion, drives with an integral already
    hold the torques that the robot needs at rest.
    """
    geometry = run.robot.geometry
    stds = run.common.body_std
    # the standard deviations are in the order of the errors, those of bodies first
    own = [one for one in _errors(run.robot) if one.name in stds]
    together = tuple(one.parameters for one in own if one.owners)
    weights = [np.full(len(one.owners), stds[one.name]) for one in own if one.owners]
    passive = passive_parameters(geometry.legs)
    places = [passive.index(one.parameters[0]) for one in own if not one.owners]
    motion = run_motion(run, found)
    of_joints = passive_columns(geometry, motion)[:, :, places] * [*stds.values()][len(together) :]
    of_bodies = body_wrenches(geometry, motion, together, weights)
    wrenches = np.concatenate([of_bodies, of_joints], axis=2)
    torques = np.einsum("tij,tjk->kti", motion.torque_maps, wrenches)
    if run.settings.drives.torques or not run.drive_law(parameters).integrates:
        return np.asarray(torques)
    return np.asarray(torques - torques[:, :1])


def _errors(robot: Robot) -> Iterator[BodyError]:
    """Yield the possible errors of centred bodies, and of passive joints without friction."""
    layout = robot.layout
    for kind in dict.fromkeys(one.name for one in layout.kinds):
        rows = tuple(
            row for row, one in enumerate(layout.kinds) if one.name == kind and not layout.full[row]
        )
        for entry in (*FIRST_MOMENTS, *PRODUCTS) if rows else ():
            names = tuple(f"{layout.bodies[row]}.{entry}" for row in rows)
            if entry in FIRST_MOMENTS:
                yield BodyError("centres", f"centres.{kind}.{entry}_kg m", rows, names)
            else:
                yield BodyError("products", f"products.{kind}.{entry}_kg m^2", rows, names)
    stated = {of_all_legs(name) for name in layout.passive_names}
    for name in passive_parameters(robot.geometry.legs):
        joint, law = name.split(".")
        if law == "viscous" and name not in stated:
            said = f"passive_friction.{joint}_N m s/rad"
            yield BodyError("passive_friction", said, (), (name,))
