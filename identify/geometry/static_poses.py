"""Static poses: readings of encoders and sensor of a robot that stands still, and their file.

The encoders are checked for wrong signs, wrong units and swapped cables.
"""

from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.run_folder import load_result

# Standard deviation (6,) of the pose of an unknown frame, m and rad, above realistic errors.
UNKNOWN_FRAME = np.repeat([0.1, 0.1], 3)
# Two poses differ if a joint differs by more than this number of standard deviations.
APART = 10.0
ROUNDING = 1e-9  # difference of a joint, rad or m, up to which two poses never count as different


@dataclass(frozen=True)
class FrameKnowledge:
    """Covariances (6, 6) [m, rad] of the small errors [dt, dphi] of a measured pose's two frames.

    Errors of the base are in base axes, and errors of the platform in platform axes. They are the
    same for all poses.
    """

    base: Array
    platform: Array

    @classmethod
    def none(cls) -> "FrameKnowledge":
        """Return the covariances of unknown frames."""
        return cls(np.diag(UNKNOWN_FRAME**2), np.diag(UNKNOWN_FRAME**2))

    @property
    def root(self) -> Array:
        """Matrix (12, 12) from independent numbers of variance one to frame errors, base first."""
        root = np.zeros((12, 12))
        for place, covariance in ((slice(0, 6), self.base), (slice(6, 12), self.platform)):
            values, vectors = np.linalg.eigh(covariance)
            root[place, place] = vectors * np.sqrt(np.maximum(values, 0.0))
        return root


@dataclass(frozen=True)
class StaticPoses:
    """Measurements of a robot at static poses.

    joints (N, n)          Joint coordinates measured by encoders, rad or m.
    joint_std (n,)         Standard deviations of the joint coordinates.
    poses (N, 6)           Measured poses, each the mean of some frames, m and rad.
    covariances (N, 6, 6)  Covariances of the poses.
    frames                 Covariances of the errors of the two frames.
    common (N, 6, k)       Shift of each pose by further independent errors of variance one that all
                           poses have in common, for example of inexact cameras.
    """

    joints: Array
    joint_std: Array
    poses: Array
    covariances: Array
    frames: FrameKnowledge
    common: Array | None = None

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def common_errors(self) -> Array:
        """Array `common`, with k = 0 if there is none."""
        return np.zeros((len(self), 6, 0)) if self.common is None else self.common

    @property
    def different(self) -> int:
        """Number of poses that differ from one another in the encoder readings."""
        apart = np.maximum(APART * self.joint_std, ROUNDING)
        kept = self.joints[:0]
        for joints in self.joints:
            if not (np.abs(kept - joints) <= apart).all(axis=1).any():
                kept = np.vstack([kept, joints])
        return len(kept)

    def entry(self, robot: Robot) -> dict[str, Any]:
        """Return the content of the JSON file that `read_static_poses` reads."""
        return {
            "joint_names": list(robot.joint_names),
            "joint_unit": robot.layout.joint_unit,
            "joints": self.joints,
            "joint_std": self.joint_std,
            "poses": self.poses,
            "covariances": self.covariances,
            "base_covariance": self.frames.base,
            "platform_covariance": self.frames.platform,
            "common": self.common,
        }


def read_static_poses(path: Path | str, robot: Robot) -> StaticPoses:
    """Read the poses of a JSON file.

    Without `base_covariance` and `platform_covariance` the frames are unknown.

    Raises RecordError if the file is unreadable, an entry is missing or has a wrong shape, a number
    is not finite, the joints have another unit, a standard deviation is negative, or a matrix is
    not a covariance.
    """
    content = load_result(path)
    if not isinstance(content.get("joints"), list):
        raise RecordError(
            f"{path} holds no poses: it needs joints, joint_std, poses and covariances"
        )
    if not content["joints"]:
        raise RecordError(f"{path} holds no poses: joints is empty")
    unit = content.get("joint_unit")
    count = len(content["joints"])
    joints = robot.layout.joints
    if unit not in (None, robot.layout.joint_unit):
        raise RecordError(
            f"{path}: joint_unit is {unit!r}, but joints of {robot.name} are in "
            f"{robot.layout.joint_unit}"
        )

    def array(name: str, *shape: int) -> Array:
        try:
            values = np.array(content[name], dtype=float)
        except KeyError:
            raise RecordError(f"{path} lacks {name}, of shape {shape}") from None
        except (TypeError, ValueError):
            raise RecordError(f"{path}: {name} must be numbers of shape {shape}") from None
        if values.shape != shape or not np.isfinite(values).all():
            raise RecordError(
                f"{path}: {name} must be finite and of shape {shape}, got {values.shape}"
            )
        return values

    known = [content.get(name) is not None for name in ("base_covariance", "platform_covariance")]
    frames = FrameKnowledge.none()
    if any(known):
        frames = FrameKnowledge(array("base_covariance", 6, 6), array("platform_covariance", 6, 6))
    covariances = array("covariances", count, 6, 6)
    for name, matrices in (
        ("covariances", covariances),
        ("frames", np.array([frames.base, frames.platform])),
    ):
        _check_covariances(f"{path}: {name}", matrices, strictly=name == "covariances")
    std = array("joint_std", joints)
    if (std < 0).any():
        raise RecordError(
            f"{path}: joint_std of joint {int(np.argmin(std)) + 1} is {std.min():g}, must be >= 0"
        )
    common = None
    if content.get("common") is not None:
        common = array("common", count, 6, _columns(content["common"]))
    return StaticPoses(
        array("joints", count, joints), std, array("poses", count, 6), covariances, frames, common
    )


def _columns(rows: Any) -> int:
    """Return k of nested lists (N, 6, k), or 1 if the lists are not nested so."""
    try:
        return len(rows[0][0])
    except (TypeError, LookupError):
        return 1


def _check_covariances(name: str, matrices: Array, strictly: bool) -> None:
    largest = np.abs(matrices).max(axis=(1, 2))
    skewed = np.abs(matrices - matrices.swapaxes(1, 2)).max(axis=(1, 2)) > 1e-9 * largest
    # Correlations have no unit, so one limit holds for the eigenvalues of all matrices.
    scale = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 1e-300))
    least = np.linalg.eigvalsh(matrices / scale[:, :, None] / scale[:, None, :]).min(axis=1)
    wrong = skewed | (least < (1e-12 if strictly else -1e-9))
    if wrong.any():
        row = int(np.argmax(wrong))
        why = (
            "is not symmetric"
            if skewed[row]
            else f"has correlations with the eigenvalue {least[row]:.2g}, which must be "
            f"{'>' if strictly else '>='} 0"
        )
        raise RecordError(f"{name}, number {row + 1}, {why}: it is not a covariance")


# Largest allowed difference between read and expected motion, as a fraction of the expected motion.
WRONG = 0.2
# Least expected motion (rms) to which the difference is related, as a fraction of the travel.
STILL = 0.1

# Ratios of readings in wrong units to right readings. The key is True for sliding actuators.
UNITS = {
    False: {
        "in degrees": 180 / pi,
        "in mrad": 1e3,
        "in turns": 0.5 / pi,
        "taken for degrees": pi / 180,
    },
    True: {"in mm": 1e3, "in um": 1e6, "in inches": 1 / 0.0254, "taken for mm": 1e-3},
}


def check_encoders(robot: Robot, data: StaticPoses) -> None:
    """Compare the readings of the encoders with the nominal joint coordinates at the poses.

    Raises RecordError if a joint moves differently. The message states what would fit: the opposite
    sign, another unit, or the readings of another joint. A constant offset is allowed. Raises
    UnreachablePoseError, naming leg and pose, for a pose that the nominal robot cannot reach.
    """
    chart = robot.geometry.chart
    poses = chart.pose(chart.coordinates(data.poses))
    robot.check_reach(poses, "measured pose", "pose")
    expected = robot.inverse_kinematics(poses)
    moves, readings = (values - values.mean(axis=0) for values in (expected, data.joints))
    still = STILL * robot.travel_limit
    wrong = [
        k
        for k in range(len(robot.joint_names))
        if _left(moves[:, k], readings[:, k], still) > WRONG
    ]
    if wrong:
        said = "; ".join(
            f"{robot.joint_names[k]} {_what_fits(robot, moves, readings, k)}" for k in wrong
        )
        raise RecordError(f"encoder readings do not fit the motion of {robot.name}: {said}")


def _what_fits(robot: Robot, moves: Array, readings: Array, joint: int) -> str:
    factors = {"": 1.0, **UNITS[robot.layout.prismatic]}
    still = STILL * robot.travel_limit
    found: list[tuple[float, bool, bool, str, int]] = [
        (
            _left(sign * factor * moves[:, joint], readings[:, other], factor * still),
            other != joint,
            sign < 0,
            unit,
            other,
        )
        for unit, factor in factors.items()
        for sign in (1, -1)
        for other in range(readings.shape[1])
    ]
    # Among equal fits `min` takes the simplest, because False sorts before True.
    unexplained, swapped, opposite, unit, other = min(found)
    if unexplained > WRONG:
        off = _left(moves[:, joint], readings[:, joint], still)
        return f"differs from the expected motion by {off:.0%}, and no sign, unit or joint fits"
    what = [f"with the readings of {robot.joint_names[other]}"] if swapped else []
    what += ["with the opposite sign"] if opposite else []
    what += [f"as readings {unit}"] if unit else []
    return f"fits {' and '.join(what)}"


def _left(expected: Array, read: Array, still: float) -> float:
    """Return the norm of the unexplained motion, relative to that of the expected motion.

    An expected motion with an rms below `still` counts as one with this rms.
    """
    least = still * len(expected) ** 0.5
    return float(np.linalg.norm(read - expected) / max(float(np.linalg.norm(expected)), least))
