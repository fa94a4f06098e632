"""The unknowns of a smooth-start trajectory (eq. 37), and the motion as a linear function of them.

The conditions of a smooth start leave 2 (n - 1) free directions a pose component: n - 1 combinations of the sines with
sum_l s_l = 0, and n - 1 of the cosines with sum_l l c_l = 0. With Z (6, 2 (n - 1)), without unit, and a box (6,)

    pose(t) = home + box Z B_0(t)^T,    pose_rate(t) = box Z B_1(t)^T,    pose_acceleration(t) = box Z B_2(t)^T,

so that every trajectory that starts smoothly at home is one vector z of 12 (n - 1) numbers, and each z one trajectory.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space

from identify.arrays import Array
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory, from_home


@dataclass(frozen=True)
class Unknowns:
    """home (6,) and box (6,) [m, rad], fundamental_hz, harmonics n."""

    home: Array
    box: Array
    fundamental_hz: float
    harmonics: int

    @property
    def columns(self) -> int:
        """Free directions a pose component, 2 (n - 1)."""
        return 2 * (self.harmonics - 1)

    @property
    def size(self) -> int:
        """Number of unknowns, 12 (n - 1)."""
        return 6 * self.columns

    def basis(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """B_0 (N, k) without unit, B_1 [1/s], B_2 [1/s²] at times ``t`` (N,) [s]; k = ``columns``."""
        order, w0 = np.arange(1, self.harmonics + 1, dtype=float), 2 * np.pi * self.fundamental_hz
        phase = np.asarray(t, dtype=float)[:, None] * w0 * order
        sin, cos = np.sin(phase), np.cos(phase)
        sines, cosines = self._directions()
        return (
            np.hstack([(sin / order) @ sines, ((1 - cos) / order) @ cosines]),
            w0 * np.hstack([cos @ sines, sin @ cosines]),
            w0**2 * np.hstack([-(sin * order) @ sines, (cos * order) @ cosines]),
        )

    def trajectory(self, z: ArrayLike) -> FourierTrajectory:
        """The trajectory of z (12 (n - 1),)."""
        matrix = np.asarray(z, dtype=float).reshape(6, self.columns)
        speed = (self.box * 2 * np.pi * self.fundamental_hz)[:, None]
        half = self.columns // 2
        sines, cosines = self._directions()
        sine, cosine = speed * matrix[:, :half] @ sines.T, speed * matrix[:, half:] @ cosines.T
        return from_home(self.home, self.fundamental_hz, sine, cosine)

    def of(self, trajectory: FourierTrajectory) -> Array:
        """z (12 (n - 1),) of a trajectory with a smooth start."""
        speed = (self.box * 2 * np.pi * self.fundamental_hz)[:, None]
        sines, cosines = self._directions()
        return np.hstack([trajectory.sine / speed @ sines, trajectory.cosine / speed @ cosines]).ravel()

    def _directions(self) -> tuple[Array, Array]:
        """Orthonormal coefficient directions (n, n - 1) of the sines and of the cosines."""
        order = np.arange(1, self.harmonics + 1, dtype=float)
        return null_space(np.ones((1, self.harmonics))), null_space(order[None])


def unknowns(home_pose: ArrayLike, settings: Excitation) -> Unknowns:
    """The unknowns of a scenario's excitation; the box is what its amplitudes allow."""
    box = np.repeat([settings.position_amplitude_m, settings.orientation_amplitude_rad], 3)
    return Unknowns(np.asarray(home_pose, dtype=float), box, settings.fundamental_hz, settings.harmonics)
