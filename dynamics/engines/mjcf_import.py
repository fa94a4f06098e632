"""Import of a robot from an MJCF file of any program.

Loops are `connect` or `weld` equalities. Home is the keyframe `home`, else the first keyframe, else
the model as it is written. The platform may have a free joint, or be the child of a leg's body. The
`numeric` elements joint_pid and travel_limit, which the exporter writes, are read back.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dynamics.checks import shown
from dynamics.engines.mechanism import Connection, Freedom, Mechanism, Solid
from dynamics.engines.mujoco_engine import import_mujoco
from dynamics.engines.recognition import recognised
from dynamics.errors import RobotFileError
from dynamics.files import LARGEST_XML, parse_xml, read_bytes
from dynamics.legs.chain import SAME
from dynamics.robot_file import RobotDescription

MOST_BODIES = 120  # largest number of bodies of a robot
MOST_FILES = 50  # largest number of files that a file includes, also through other files


def robot_of_mjcf(path: str | Path) -> tuple[RobotDescription, list[str]]:
    """Robot in an MJCF file, and remarks on the file.

    MuJoCo can make a model of any size from a small file. For a file from an untrusted author, use
    ``cmmsim import mjcf``, which limits time and memory.

    Raises RobotFileError if MuJoCo refuses the file, or if its mechanism has legs of no known kind.
    Raises MujocoMissingError if MuJoCo is not installed, and MujocoError if it does not load.
    """
    mujoco = import_mujoco()
    _refuse_large(Path(path))
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise RobotFileError(f"MuJoCo refuses {path}: {' '.join(str(error).split())}") from None
    try:
        return recognised(_mechanism(mujoco, model))
    except RobotFileError as error:
        raise RobotFileError(f"{path}: {error}") from None


def _refuse_large(path: Path, read: set[Path] | None = None) -> int:
    """Count the bodies of a file and of the files that it includes.

    `read` are the files that were read before. Raises RobotFileError if the file has more than
    MOST_BODIES bodies, or includes a file of another folder, a file twice, or too many files.
    """
    read = {path} if read is None else read
    content = read_bytes(path, str(path), RobotFileError, LARGEST_XML)
    bodies = 0
    for element in parse_xml(content, str(path), RobotFileError).iter():
        bodies += element.tag == "body"
        if element.tag == "include":
            name = Path(element.get("file", ""))
            included = path.parent / name
            if (
                name.is_absolute()
                or ".." in name.parts
                or included in read
                or len(read) > MOST_FILES
            ):
                raise RobotFileError(
                    f"{path} includes {shown(str(name))}; it may only include files of its own "
                    f"folder, at most {MOST_FILES}, and each of them once"
                )
            read.add(included)
            bodies += _refuse_large(included, read)
    if bodies > MOST_BODIES:
        raise RobotFileError(f"{path} has {bodies} bodies, a robot has at most {MOST_BODIES}")
    return bodies


def _mechanism(mujoco: Any, model: Any) -> Mechanism:
    """Mechanism of a model."""
    data = mujoco.MjData(model)
    if model.nkey:
        home = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
        mujoco.mj_resetDataKeyframe(model, data, max(home, 0))
    mujoco.mj_forward(model, data)
    _refuse_others(mujoco, model)
    solids = [_solid(mujoco, model, data, body) for body in range(model.nbody)]
    driven = {int(model.actuator_trnid[k, 0]): k for k in range(model.nu)}
    connections = []
    for body in range(1, model.nbody):
        first = int(model.body_jntadr[body])
        count = int(model.body_jntnum[body])
        joints = range(first, first + count)
        if any(model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE) for joint in joints):
            # The platform floats: only the legs connect it to the base.
            continue
        freedoms = tuple(
            _freedom(mujoco, model, data, joint, driven.get(joint)) for joint in joints
        )
        connections.append(Connection(int(model.body_parentid[body]), body, freedoms))
    connections += [_loop(mujoco, model, data, k) for k in range(model.neq) if model.eq_active0[k]]
    limited = [joint for joint in range(model.njnt) if model.jnt_limited[joint]]
    travel = _numeric(model, "travel_limit")
    return Mechanism(
        name=bytes(model.names).split(b"\0")[0].decode(),
        solids=solids,
        connections=connections,
        gravity=np.array(model.opt.gravity),
        ranges={
            _joint_name(model, joint): tuple(model.jnt_range[joint].tolist()) for joint in limited
        },
        gains=_numeric(model, "joint_pid"),
        travel_limit=float(travel[0]) if travel is not None and len(travel) == 1 else None,
    )


def _solid(mujoco: Any, model: Any, data: Any, body: int) -> Solid:
    """Body of a model. The rod that draws it is its first capsule or cylinder."""
    base_from_principal = data.ximat[body].reshape(3, 3)
    rods = [int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)]
    first = int(model.body_geomadr[body])
    rod = None
    for geom in range(first, first + int(model.body_geomnum[body])):
        if rod is None and model.geom_type[geom] in rods:
            rod = (2 * float(model.geom_size[geom, 1]), float(model.geom_size[geom, 0]))
    return Solid(
        name=model.body(body).name or f"body {body}",
        mass=float(model.body_mass[body]),
        centre=data.xipos[body].copy(),
        inertia=base_from_principal @ np.diag(model.body_inertia[body]) @ base_from_principal.T,
        axes=data.xmat[body].reshape(3, 3).copy(),
        rod=rod,
    )


def _freedom(mujoco: Any, model: Any, data: Any, joint: int, actuator: int | None) -> Freedom:
    """Elementary joint of a model. Raises RobotFileError for stiffness or armature."""
    kind = {
        int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
        int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
        int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    }[int(model.jnt_type[joint])]
    name = _joint_name(model, joint)
    dof = int(model.jnt_dofadr[joint])
    for what, value in (
        ("stiffness", model.jnt_stiffness[joint]),
        ("armature", model.dof_armature[dof]),
    ):
        if value:
            raise RobotFileError(f"{name} has {what} {value:g}, which cannot be imported")
    return Freedom(
        kind,
        name,
        data.xanchor[joint].copy(),
        np.full(3, np.nan) if kind == "ball" else data.xaxis[joint].copy(),
        float(data.qpos[model.jnt_qposadr[joint]]),
        (float(model.dof_frictionloss[dof]), float(model.dof_damping[dof])),
        actuator,
    )


def _joint_name(model: Any, joint: int) -> str:
    """Name of a joint."""
    return model.joint(joint).name or f"joint {joint}"


def _loop(mujoco: Any, model: Any, data: Any, equality: int) -> Connection:
    """Connection that closes a loop between two sites or two bodies, as a ball joint or a weld.

    Raises RobotFileError if the loop is open at home.
    """
    weld = model.eq_type[equality] == int(mujoco.mjtEq.mjEQ_WELD)
    first, second = (int(ids[equality]) for ids in (model.eq_obj1id, model.eq_obj2id))
    name = model.equality(equality).name or f"equality {equality}"
    if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
        points = [data.site_xpos[site] for site in (first, second)]
        axes = [data.site_xmat[site].reshape(3, 3) for site in (first, second)]
        first, second = (int(model.site_bodyid[site]) for site in (first, second))
    else:
        given = model.eq_data[equality]
        # MuJoCo writes the anchor of a weld in the second body first
        anchors = given[:6].reshape(2, 3)[:: -1 if weld else 1]
        axes = [data.xmat[body].reshape(3, 3) for body in (first, second)]
        bodies = zip((first, second), axes, anchors, strict=True)
        points = [data.xpos[body] + turn @ anchor for body, turn, anchor in bodies]
        if weld:
            axes[0] = axes[0] @ Rotation.from_quat(given[6:10], scalar_first=True).as_matrix()
    gap = float(np.linalg.norm(points[0] - points[1]))
    if gap > SAME:
        raise RobotFileError(
            f"the loop {name} is open by {gap:.3g} m at home, must be closed to {SAME:g} m"
        )
    if weld:
        turn = float(Rotation.from_matrix(axes[0].T @ axes[1]).magnitude())
        if turn > SAME:
            raise RobotFileError(
                f"the loop {name} is turned by {turn:.3g} rad at home, must be closed to {SAME:g} "
                "rad"
            )
        return Connection(first, second, ())
    return Connection(first, second, (Freedom("ball", name, points[0].copy(), np.full(3, np.nan)),))


def _refuse_others(mujoco: Any, model: Any) -> None:
    """Raise RobotFileError for loops, tendons or actuators that cannot be imported."""
    known = [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)]
    for k in range(model.neq):
        if model.eq_active0[k] and model.eq_type[k] not in known:
            kind = mujoco.mjtEq(int(model.eq_type[k])).name.removeprefix("mjEQ_").lower()
            name = model.equality(k).name or k
            raise RobotFileError(f"equality {name} is of the kind {kind}, must be connect or weld")
    if model.ntendon:
        raise RobotFileError(f"it has {model.ntendon} tendons, which no kind of leg has")
    for k in range(model.nu):
        if model.actuator_trntype[k] != int(mujoco.mjtTrn.mjTRN_JOINT):
            raise RobotFileError(f"actuator {model.actuator(k).name or k} drives no joint")


def _numeric(model: Any, name: str) -> np.ndarray | None:
    """Numbers of the element `numeric` with a name, or None if the file has no such element."""
    try:
        return np.array(model.numeric(name).data, dtype=float)
    except KeyError:
        return None
