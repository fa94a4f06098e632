"""Selection of static poses by an observability index over candidates within the travel.

The index (see `observability`) is computed from the information about geometry and frames together.
Poses are chosen one by one from the candidates (greedy), and then exchanged for better ones in a
few passes. A gradient search in joint space can then optimise all poses together.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from cmmsim.visibility import SightLines
from dynamics import Robot
from dynamics.workspace import measure
from identify.arrays import Array
from identify.errors import EstimationError
from identify.excitation.constraints import required_stickers
from identify.geometry.calibration import PoseModel, whiteners
from identify.geometry.observability import ObservabilityIndex, chosen_index
from identify.progress import Advance

STEP = 1e-5  # step of the difference quotients in the gradient, as a fraction of the travel
GRADIENT_STEPS = 40  # largest number of steps of one gradient search
# Largest number of gradient searches. Poses that violated a limit after a search are fixed in the
# next search.
ROUNDS = 4
EXCHANGES = 3  # largest number of passes over all poses in which each can be exchanged
TRIALS = 40  # largest number of random vectors of joint coordinates per candidate


@dataclass(frozen=True)
class Limits:
    """Limits of static poses: travel (rad or m), singularities and visibility.

    Visibility is checked only if ``sight`` is given.
    """

    robot: Robot
    travel: float
    least_leverage: float
    most_condition: float
    sight: SightLines | None

    def allowed(self, poses: Array) -> NDArray[np.bool_]:
        """Return which poses (N, 6) are within the limits."""
        measures = measure(self.robot, poses)
        good = measures.reachable & (np.abs(measures.theta) <= self.travel * (1 + 1e-9)).all(axis=1)
        good &= measures.leverage.min(axis=1) >= self.least_leverage
        good &= measures.platform_condition <= self.most_condition
        return np.array(
            [ok and self._in_sight(pose) for ok, pose in zip(good, poses, strict=True)], dtype=bool
        )

    def _in_sight(self, pose: Array) -> bool:
        return self.sight is None or bool(self.sight.visible(pose)[self._stickers].all())

    @cached_property
    def _stickers(self) -> list[int]:
        return [] if self.sight is None else required_stickers(self.sight, self.robot.home_pose)


@dataclass(frozen=True)
class Candidates:
    """Joint coordinates (N, n) [rad or m], the nominal robot's poses (N, 6), and their information.

    ``columns`` (N, m, u) are the whitened derivatives with respect to the unknowns in units of
    their prior.
    """

    joints: Array
    poses: Array
    columns: Array

    def __len__(self) -> int:
        return len(self.joints)

    def of(self, rows: Array | list[int]) -> "Candidates":
        """Return the candidates with these indices."""
        return Candidates(self.joints[rows], self.poses[rows], self.columns[rows])

    @property
    def information(self) -> Array:
        """Information (u, u) of all poses together."""
        return np.asarray(np.einsum("nmu,nmv->uv", self.columns, self.columns))

    @property
    def with_prior(self) -> Array:
        """Information (u, u) of all poses together with the prior."""
        return self.information + np.eye(self.columns.shape[2])


@dataclass(frozen=True)
class Designer:
    """Designer of pose sets for a model.

    ``covariance`` (6, 6) is that of a measured pose, the mean of its frames. ``joint_std`` (n,) is
    the standard deviation of the encoders' mean readings. ``criterion`` names the index.
    """

    model: PoseModel
    limits: Limits
    covariance: Array
    joint_std: Array
    criterion: str = "determinant"

    def candidates(self, count: int, rng: np.random.Generator) -> Candidates:
        """Draw random joint coordinates within the travel, with poses within the limits.

        Raises EstimationError if `TRIALS` draws per candidate give too few such poses.
        """
        kept_joints: list[Array] = []
        kept_poses: list[Array] = []
        robot = self.limits.robot
        travel = self.limits.travel
        for _ in range(TRIALS):
            joints = rng.uniform(-travel, travel, (count, robot.layout.joints))
            poses = self._poses(joints, np.tile(robot.home_pose, (count, 1)))
            known = np.flatnonzero(np.isfinite(poses).all(axis=1))
            known = known[self.limits.allowed(poses[known])]
            kept_joints.append(joints[known])
            kept_poses.append(poses[known])
            if sum(map(len, kept_joints)) >= count:
                break
        joints = np.concatenate(kept_joints)[:count]
        poses = np.concatenate(kept_poses)[:count]
        if len(joints) < count:
            raise EstimationError(
                f"only {len(joints)} of {count * TRIALS} random joint coordinates of {robot.name} "
                f"within its travel ({travel:.3g} {robot.layout.joint_unit}) give visible poses "
                f"within all limits; {count} are needed"
            )
        return self.seen(joints, poses)

    def seen(self, joints: Array, poses: Array) -> Candidates:
        """Return candidates with joint coordinates (N, n), poses (N, 6) and their information."""
        none = np.zeros(len(self.model.scale))
        free = list(self.limits.robot.geometry.chart.freedoms)
        columns, by_joints = self.model.columns(joints, poses, none)
        return Candidates(
            joints,
            poses,
            whiteners(self.covariance[np.ix_(free, free)], by_joints, self.joint_std) @ columns,
        )

    def greedy(
        self, among: Candidates, count: int, advance: Advance = lambda n=1: None
    ) -> Candidates:
        """Choose the best candidates one by one, then exchange each for the best in its place.

        The passes over all poses end when none is exchanged, or after `EXCHANGES`. The same
        candidate can be chosen twice.
        """
        index = self.index(among)
        chosen = list[int]()
        own = among.columns.swapaxes(1, 2) @ among.columns
        prior = np.eye(among.columns.shape[2])
        information = prior
        for _ in range(count):
            chosen.append(index.best(among.columns, information))
            information = information + own[chosen[-1]]
            advance()
        for _ in range(EXCHANGES):
            before = list(chosen)
            for k in range(count):
                # The sum is computed again, because a difference of two sums would lose directions
                # with little information.
                information = prior + own[chosen[:k] + chosen[k + 1 :]].sum(axis=0)
                chosen[k] = index.best(among.columns, information)
            if chosen == before:
                break
        return among.of(chosen)

    def moved(self, chosen: Candidates, among: Candidates) -> Candidates:
        """Return poses after gradient searches of the index in joint space.

        Their index is not worse than before. A pose that would violate a limit is not moved.
        """
        index = self.index(among)
        held = np.zeros(len(chosen), dtype=bool)
        best = chosen
        for _ in range(ROUNDS):
            joints = self._along_gradient(chosen, held, index)
            poses = self._poses(joints, chosen.poses)
            closed = np.flatnonzero(np.isfinite(poses).all(axis=1))
            forbidden = np.ones(len(chosen), dtype=bool)
            forbidden[closed] = ~self.limits.allowed(poses[closed])
            joints[forbidden] = chosen.joints[forbidden]
            poses[forbidden] = chosen.poses[forbidden]
            best = min(
                best, self.seen(joints, poses), key=lambda found: index.value(found.with_prior)[0]
            )
            if not forbidden.any():
                break
            held |= forbidden
        return best

    def _along_gradient(
        self, chosen: Candidates, held: NDArray[np.bool_], index: ObservabilityIndex
    ) -> Array:
        """Return joint coordinates (N, n) within the travel after one gradient search.

        Poses that are `held` do not move.
        """
        shape = chosen.joints.shape
        travel = self.limits.travel
        near = chosen.poses

        def worth(values: Array) -> tuple[float, Array]:
            nonlocal near
            joints = values.reshape(shape) * travel
            poses = self._poses(joints, near)
            if not np.isfinite(poses).all():
                return np.inf, np.zeros(values.size)
            # The next search for poses starts here, and thus finds the same assembly mode.
            near = poses
            now = self.seen(joints, poses)
            found, descent = index.value(now.with_prior)
            pull = np.einsum("uv,nmv->nmu", descent, now.columns)
            gradient = np.empty(shape)
            for joint in range(shape[1]):
                ahead = joints + STEP * travel * np.eye(shape[1])[joint]
                columns = self.seen(ahead, self._poses(ahead, poses)).columns
                gradient[:, joint] = -2 * np.einsum(
                    "nmu,nmu->n", pull, (columns - now.columns) / STEP
                )
            return found, gradient.ravel()

        start = chosen.joints / travel
        free = ~held[:, None]
        low = np.where(free, -1.0, start)
        high = np.where(free, 1.0, start)
        bounds = list(zip(low.ravel(), high.ravel(), strict=True))
        steps = {"maxiter": GRADIENT_STEPS}
        found = minimize(
            worth, start.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options=steps
        )
        return np.asarray(found.x.reshape(shape) * travel)

    def index(self, among: Candidates) -> ObservabilityIndex:
        """Return the index of the criterion, relative to the information of these candidates."""
        return chosen_index(self.criterion, among.information, len(among))

    def _poses(self, joints: Array, start: Array) -> Array:
        """Return the poses (N, 6) of the nominal robot. They are NaN if the loops do not close."""
        return self.model.closure.nearest(joints, np.zeros(len(self.model.tolerance)), start)
