"""Static poses: what encoders read and what the optical CMM measured while a robot stood still; and
their file.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dynamics import Robot
from identify.arrays import Array
from identify.errors import RecordError
from identify.files.run_folder import load_result

UNKNOWN_FRAME = np.repeat([0.1, 0.1], 3)
"""Standard deviation (6,) of a frame of which nothing is known, m and rad: more than where any
robot is put.
"""

APART, ROUNDING = 10.0, 1e-9
"""Standard deviations of the encoders, and rad or m, by which different poses differ in some joint.
"""


@dataclass(frozen=True)
class FrameKnowledge:
    """How well the two frames that a pose is between are known: covariances (6, 6) of the small
    errors [dt, dphi] of the base, in base axes, and of the platform, in platform axes, m and rad.
    They are one draw for all poses."""

    base: Array
    platform: Array

    @classmethod
    def none(cls) -> "FrameKnowledge":
        """Nothing is known of them."""
        return cls(np.diag(UNKNOWN_FRAME**2), np.diag(UNKNOWN_FRAME**2))

    @property
    def root(self) -> Array:
        """A matrix (12, 12) that makes errors of both, base first, of independent numbers of
        variance one.
        """
        root = np.zeros((12, 12))
        for place, covariance in ((slice(0, 6), self.base), (slice(6, 12), self.platform)):
            values, vectors = np.linalg.eigh(covariance)
            root[place, place] = vectors * np.sqrt(np.maximum(values, 0.0))
        return root


@dataclass(frozen=True)
class StaticPoses:
    """Poses at which a robot stood: joint coordinates that its encoders read (N, n) with their
    standard deviation (n,), rad or m; measured poses (N, 6), each the mean of some frames, with
    covariances (N, 6, 6), m and rad; how well the frames of the measurement are known; and common
    (N, 6, k): what errors of variance one that all poses have in common, beside those of the
    frames, add to each, as those of cameras that are known only so well; None: nothing."""

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
        """As `common`, with k = 0 where there is nothing."""
        return np.zeros((len(self), 6, 0)) if self.common is None else self.common

    @property
    def different(self) -> int:
        """How many of the poses differ in what the encoders read, by more than their noise
        makes."""
        apart = np.maximum(APART * self.joint_std, ROUNDING)
        kept = self.joints[:0]
        for joints in self.joints:
            if not (np.abs(kept - joints) <= apart).all(axis=1).any():
                kept = np.vstack([kept, joints])
        return len(kept)

    def entry(self, robot: Robot) -> dict[str, Any]:
        """What `read_static_poses` reads, as JSON holds it."""
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
    """Read the poses of a JSON file; without `base_covariance` and `platform_covariance` the frames
    are unknown.

    Raises RecordError: unreadable, an entry that is missing or of another shape, numbers that are
    not finite, joints of another unit, or a covariance that is none.
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
            f"{path}: joint_unit is {unit!r}, joints of {robot.name} are in "
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
    """Length of the first of the innermost of nested lists; one where there is none."""
    try:
        return len(rows[0][0])
    except (TypeError, LookupError):
        return 1


def _check_covariances(name: str, matrices: Array, strictly: bool) -> None:
    skewed = np.abs(matrices - matrices.swapaxes(1, 2)).max(axis=(1, 2)) > 1e-9 * np.abs(
        matrices
    ).max(axis=(1, 2))
    scale = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 1e-300))
    least = np.linalg.eigvalsh(matrices / scale[:, :, None] / scale[:, None, :]).min(axis=1)
    wrong = skewed | (least < (1e-12 if strictly else -1e-9))
    if wrong.any():
        row = int(np.argmax(wrong))
        why = (
            "is not symmetric"
            if skewed[row]
            else f"has the eigenvalue {least[row]:.2g} as correlations, must be > 0"
        )
        raise RecordError(f"{name}, number {row + 1}, {why}: no covariance")
