"""Errors of a model whose bodies and passive joints are simpler than those of the robot.

A model with centred bodies assumes nominal positions of the centres of mass, and products of
inertia of zero. A model without friction of passive joints lets them turn freely. Most differences
of a real robot from such a model leave no residual, because wrong values of the parameters
compensate them. Standard deviations of these differences are therefore stated, in the robot file or
in the scenario. The differences are estimated as errors that all poses of a record have in common,
and widen the intervals of the parameters.

All bodies of a kind are made alike, and have the same error, each in its own axes. Passive joints
between the same kinds of bodies have the same error, too. The errors act as torques at the joints
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

LEAST_COMMAND = 1e-10  # change of a command, rad, m, N m or N, below which it counts as zero


@dataclass(frozen=True)
class BodyError:
    """Error that all bodies of a kind, or a passive joint of all legs, have in common.

    kind, name  Kind of the error in `identification.nuisances`, and name of the error. The name
                begins with the kind and ends with the unit.
    owners      Rows of the bodies in the layout of the robot. There are none for a passive joint.
    parameters  Names of the parameters that the model takes as zero: one for each owner, or the
                friction of the joint.
    """

    kind: str
    name: str
    owners: tuple[int, ...]
    parameters: tuple[str, ...]


def body_error_stds(robot: Robot, model: Model, kinds: tuple[str, ...]) -> dict[str, float]:
    """Return, by name, the standard deviations of some kinds of errors of bodies and joints.

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
    scales = {
        "centres": bodies[:, 0] * robot.geometry.body_lengths,
        "products": bodies[:, 4:7].mean(axis=1),
    }
    stds = {}
    for error in _errors(robot):
        scale = float(scales[error.kind][list(error.owners)].mean()) if error.owners else 1.0
        if (std := stated[error.kind] * scale) and error.kind in kinds:
            stds[error.name] = std
    return stds


def body_errors(run: "LoopModel", parameters: Array) -> Array | None:
    """Return the changes (k, N, n) of commands with the effect of each error of a run's bodies.

    Errors of passive joints are included. The changes are for one standard deviation of each error,
    along the motion with parameters (p,). They are in rad or m, or in N m or N if the drives take
    torques. Without such errors, the result is None. Raises LoopFailure if the model is unstable.
    """
    if not run.common.body_std:
        return None
    torques = _torques(run, parameters, run.simulate(parameters))
    if run.settings.drives.torques:
        return -torques
    needed = run.commands_for(torques.transpose(1, 0, 2), run.drive_law(parameters))
    return -needed.transpose(1, 0, 2)


def body_modes(run: "LoopModel", parameters: Array) -> dict[int, Array | float]:
    """Return, by index of the error, the changes (N, 6) of a run's poses by its errors of bodies.

    An error that needs no torque has the change 0.0. If the drives take torques, only such errors
    are returned. Otherwise, one run is differentiated along the changes of the commands.
    parameters (p,): those of the run. Raises LoopFailure if the model is unstable.
    """
    if run.bodies is None:
        return {}
    first = len(run.errors_had) - len(run.bodies)
    # a crank about a vertical axis, for example, needs no torque for most of its errors
    moving = np.abs(run.bodies).max(axis=(1, 2)) >= LEAST_COMMAND
    by_index: dict[int, Array | float] = {first + int(k): 0.0 for k in np.flatnonzero(~moving)}
    if run.settings.drives.torques:
        return by_index
    found, changes = differentiated(run, parameters, run.bodies[moving].transpose(1, 2, 0))
    run.known_runs.add(parameters, found)
    indices = first + np.flatnonzero(moving)
    return by_index | {int(index): changes[:, :, k] for k, index in enumerate(indices)}


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

    found: run of the model at parameters (p,). Drives with an integral already hold the torques of
    the first frame before the motion. These torques are then subtracted.
    """
    geometry = run.robot.geometry
    stds = run.common.body_std
    # the standard deviations are in the order of the errors, those of bodies first
    errors = [error for error in _errors(run.robot) if error.name in stds]
    together = tuple(error.parameters for error in errors if error.owners)
    weights = [np.full(len(error.owners), stds[error.name]) for error in errors if error.owners]
    passive = passive_parameters(geometry.legs)
    columns = [passive.index(error.parameters[0]) for error in errors if not error.owners]
    motion = run_motion(run, found)
    of_joints = passive_columns(geometry, motion)[:, :, columns] * [*stds.values()][len(together) :]
    of_bodies = body_wrenches(geometry, motion, together, weights)
    wrenches = np.concatenate([of_bodies, of_joints], axis=2)
    torques = np.einsum("tij,tjk->kti", motion.torque_maps, wrenches)
    if run.settings.drives.torques or not run.drive_law(parameters).integrates:
        return np.asarray(torques)
    return np.asarray(torques - torques[:, :1])


def _errors(robot: Robot) -> Iterator[BodyError]:
    """Yield the possible errors of centred bodies, and of passive joints without friction."""
    layout = robot.layout
    for kind in dict.fromkeys(body.name for body in layout.kinds):
        rows = tuple(
            row
            for row, body in enumerate(layout.kinds)
            if body.name == kind and not layout.full[row]
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
            error_name = f"passive_friction.{joint}_N m s/rad"
            yield BodyError("passive_friction", error_name, (), (name,))
