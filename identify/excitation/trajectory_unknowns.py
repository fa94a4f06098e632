"""Unknowns of a smooth-start trajectory (eq. 37), with its motion and regressors in CasADi.

A `FourierTrajectory` of n harmonics has coefficients s_l of the sines and c_l of the cosines for
each coordinate. A smooth start requires sum_l s_l = 0 and sum_l l c_l = 0. Each condition leaves
n - 1 free directions, together 2 (n - 1) for each coordinate. The m coordinates are

    q(t) = home + D Z B_0(t)^T,    q_dot(t) = D Z B_1(t)^T,    q_ddot(t) = D Z B_2(t)^T.

D is the diagonal matrix of `Unknowns.box`. Z is a dimensionless matrix (m, 2 (n - 1)). The bases
B_0, B_1 and B_2 are those of `Unknowns.basis`. The unknowns z are the 2 m (n - 1) entries of Z, row
by row. They correspond one-to-one to the trajectories with a smooth start at home.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space

from dynamics import Robot
from dynamics.kinematics.platform import Chart, pose_rate_to_twist, twist_bias
from dynamics.rigid_body.jacobians import joint_jacobian, pose_basis
from dynamics.rigid_body.regressor import rigid_body_regressor
from identify.arrays import Array, agreed
from identify.scenario import Excitation
from identify.trajectory import FourierTrajectory, box_of, from_home


@dataclass(frozen=True)
class Unknowns:
    """Unknowns of a trajectory that starts at the home of a chart.

    ``box`` (m,) [m, rad] scales the coordinates, and ``harmonics`` is n.
    """

    chart: Chart
    box: Array
    fundamental_hz: float
    harmonics: int

    @property
    def home(self) -> Array:
        """Pose (6,) at the start."""
        return np.array(self.chart.home)

    @property
    def coordinates(self) -> int:
        """Number of coordinates m."""
        return len(self.chart.freedoms)

    @property
    def columns(self) -> int:
        """Number of free directions per coordinate, 2 (n - 1)."""
        return 2 * (self.harmonics - 1)

    @property
    def size(self) -> int:
        """Number of unknowns, 2 m (n - 1)."""
        return self.coordinates * self.columns

    def basis(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the bases B_0, B_1 [1/s] and B_2 [1/s²] at times ``t`` (N,) [s].

        Each has the shape (N, k), where k = ``columns``. B_0 has no unit.
        """
        order = np.arange(1, self.harmonics + 1, dtype=float)
        w0 = 2 * np.pi * self.fundamental_hz
        phase = np.asarray(t, dtype=float)[:, None] * w0 * order
        sin = np.sin(phase)
        cos = np.cos(phase)
        sines, cosines = self._directions()
        return (
            np.hstack([(sin / order) @ sines, ((1 - cos) / order) @ cosines]),
            w0 * np.hstack([cos @ sines, sin @ cosines]),
            w0**2 * np.hstack([-(sin * order) @ sines, (cos * order) @ cosines]),
        )

    def trajectory(self, z: ArrayLike) -> FourierTrajectory:
        """Return the trajectory of z (2 m (n - 1),)."""
        matrix = np.asarray(z, dtype=float).reshape(self.coordinates, self.columns)
        speed = (self.box * 2 * np.pi * self.fundamental_hz)[:, None]
        half = self.columns // 2
        sines, cosines = self._directions()
        sine = speed * matrix[:, :half] @ sines.T
        cosine = speed * matrix[:, half:] @ cosines.T
        return from_home(self.chart, self.fundamental_hz, sine, cosine)

    def of(self, trajectory: FourierTrajectory) -> Array:
        """Return z (2 m (n - 1),) of a trajectory with a smooth start."""
        speed = (self.box * 2 * np.pi * self.fundamental_hz)[:, None]
        sines, cosines = self._directions()
        return np.hstack(
            [trajectory.sine / speed @ sines, trajectory.cosine / speed @ cosines]
        ).ravel()

    def _directions(self) -> tuple[Array, Array]:
        """Return orthonormal coefficient directions (n, n - 1) of the sines and of the cosines."""
        order = np.arange(1, self.harmonics + 1, dtype=float)
        return null_space(np.ones((1, self.harmonics))), null_space(order[None])


def unknowns(chart: Chart, settings: Excitation) -> Unknowns:
    """Return the unknowns of a scenario's excitation about a chart's home.

    The box has the amplitudes of the scenario.
    """
    box = box_of(chart, settings.position_amplitude_m, settings.orientation_amplitude_rad)
    return Unknowns(chart, box, settings.fundamental_hz, settings.harmonics)


# Number of poses per period of the highest harmonic at which a criterion is evaluated.
SAMPLES_PER_HARMONIC = 20


def sample_times(fundamental_hz: float, harmonics: int, refinement: int = 1) -> Array:
    """Return instants (N,) [s] over one period of the fundamental.

    They exclude both ends of the period, where the robot rests.
    """
    count = refinement * SAMPLES_PER_HARMONIC * harmonics
    return np.asarray((np.arange(count) + 0.5) / (count * fundamental_hz), dtype=float)


def is_whole_periods(duration_s: float, fundamental_hz: float) -> bool:
    """Return whether a run is a whole number of periods, at least one, up to rounding."""
    periods = duration_s * fundamental_hz
    return round(periods) >= 1 and abs(periods - round(periods)) <= 1e-9 * periods


def run_times(fundamental_hz: float, harmonics: int, duration_s: float) -> Array:
    """Return instants (N,) [s], as dense as `sample_times`, over the run of a trajectory.

    If the run is a whole number of periods, they cover one period, because the motion repeats.
    """
    if is_whole_periods(duration_s, fundamental_hz):
        return sample_times(fundamental_hz, harmonics)
    count = max(1, round(SAMPLES_PER_HARMONIC * harmonics * fundamental_hz * duration_s))
    return np.asarray((np.arange(count) + 0.5) * (duration_s / count), dtype=float)


def motion(unknowns: Unknowns, z: ca.MX, times: Array) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Return poses, pose rates and pose accelerations, each (6, N), of z at `times` (N,) [s].

    The basis is rounded to numbers on which all processors agree. This changes the position by less
    than a nanometre.
    """
    matrix = ca.reshape(z, unknowns.columns, unknowns.coordinates).T
    scale = ca.sparsify(ca.DM(unknowns.chart.basis @ np.diag(unknowns.box)))
    offset, rate, acceleration = (
        scale @ matrix @ ca.DM(agreed(b.T)) for b in unknowns.basis(times)
    )
    return ca.repmat(ca.DM(unknowns.home), 1, len(times)) + offset, rate, acceleration


# Number of bits to which the response of a linearised loop is rounded. It is small because the
# response is computed by difference quotients.
RESPONSE_BITS = 16


def tracked_motion(
    unknowns: Unknowns, z: ca.MX, times: Array, tracking: NDArray[np.complex128]
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Return the steady-state motion of a robot that follows z with a lag.

    `tracking` (harmonics, m, m) is the complex gain of the loop at each harmonic. The mean is
    followed exactly. For the returned arrays see `motion`.
    """
    speeds = 2j * np.pi * unknowns.fundamental_hz * np.arange(1, unknowns.harmonics + 1)
    period = sample_times(unknowns.fundamental_hz, unknowns.harmonics)
    basis = unknowns.basis(period)[0]
    box = np.diag(unknowns.box)
    maps = [np.zeros((len(times), unknowns.coordinates, unknowns.size)) for _ in range(3)]
    maps[0] += np.kron(box, basis.mean(axis=0))
    for s, followed in zip(speeds, tracking, strict=True):
        # Fourier coefficient of the basis at this harmonic.
        coefficient = 2 / len(period) * np.exp(-s * period) @ basis
        amplitude = np.exp(s * times)[:, None, None] * np.kron(followed @ box, coefficient)
        for derivative, total in enumerate(maps):
            total += (s**derivative * amplitude).real
    arrays = []
    for total in maps:
        lifted = agreed(unknowns.chart.lifted(total, axis=1), RESPONSE_BITS)
        arrays.append(ca.reshape(ca.DM(lifted.reshape(-1, unknowns.size)) @ z, 6, len(times)))
    offset, rate, acceleration = arrays
    return ca.repmat(ca.DM(unknowns.home), 1, len(times)) + offset, rate, acceleration


def regressor(
    robot: Robot, smoothing: float | None, of: Literal["wrench", "torque"]
) -> ca.Function:
    """Return the function (pose, rate, acceleration) (6,) -> transposed regressor (p, m) or (p, n).

    It is the regressor of the wrench (eq. 25) along the m coordinates, or of the n actuators'
    torques. With J the Jacobian of the joints along the m coordinates, the wrench is J^T times the
    torques. The sign of Coulomb friction has no derivative. `smoothing` replaces it by
    tanh(theta_dot / v_s) with v_s in rad/s, or m/s for sliding actuators. With None the sign is
    used.
    """
    pose, rate, acceleration = (ca.SX.sym(name, 6) for name in ("pose", "rate", "acceleration"))
    to_twist = pose_rate_to_twist(pose)
    twist = to_twist @ rate
    twist_dot = to_twist @ acceleration + twist_bias(pose, rate)
    jacobian = joint_jacobian(robot.geometry, pose)
    velocity = jacobian @ twist
    sign = ca.sign(velocity) if smoothing is None else ca.tanh(velocity / smoothing)
    basis = pose_basis(robot.geometry)
    rigid = basis.T @ rigid_body_regressor(robot.geometry, pose, twist, twist_dot)
    along = jacobian @ basis
    friction = ca.horzcat(ca.diag(sign), ca.diag(velocity))
    if of == "torque":
        columns = ca.horzcat(ca.solve(along.T, rigid), friction)
    else:
        columns = ca.horzcat(rigid, along.T @ friction)
    return ca.Function("regressor", [pose, rate, acceleration], ca.cse([ca.densify(columns.T)]))


@lru_cache(maxsize=4)
def log_determinant(size: int) -> ca.Function:
    """Return the function of a matrix (size, size) -> ln det, by LDL^T.

    Only the upper triangle is read. The value is NaN or -inf if the matrix is not positive
    definite.
    """
    matrix = ca.SX.sym("matrix", size, size)
    upper = ca.triu(matrix)
    diagonal, _, _ = ca.ldl(upper + ca.triu(matrix, False).T, False)
    return ca.Function("log_determinant", [matrix], [ca.sum1(ca.log(diagonal))])
