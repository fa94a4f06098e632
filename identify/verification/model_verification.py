"""The paper's model validation (section 4.1): this model against MuJoCo in figure 7's loop, with its goals."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dynamics import Robot
from dynamics.analysis.physical_inertia import grouped, physical_inertias
from dynamics.parameters import COULOMB, VISCOUS
from identify.arrays import Array
from identify.progress import Progress
from identify.verification.figure7_loop import SOLVER, EngineRuns, compare_engines

DURATION_S = 10.0
STEADY_FROM_S = 2.0
PARAMETER_SET = "initial"

GOAL_UM, GOAL_URAD = 10.0, 20.0
PAPER = {"position_max_um": 1250.0, "angle_max_urad": 3250.0, "position_steady_um": 100.0, "angle_steady_urad": 250.0}


@dataclass(frozen=True)
class Verdict:
    """Largest differences between the engines, of the whole run and from STEADY_FROM_S on: distances of the platform
    [um], lengths of the vector of Euler angle differences [urad], crank torque [N m]; MuJoCo's loop closure error [um]
    and link spin [rad/s]; how far this model is from its reference [um, urad], which is what the PID leaves to see."""

    position_max_um: float
    position_steady_um: float
    angle_max_urad: float
    angle_steady_urad: float
    torque_max_nm: float
    closure_max_um: float
    spin_max_rad_s: float
    tracking_max_um: float
    tracking_max_urad: float

    @property
    def met(self) -> bool:
        """Whether the steady differences are within the goals."""
        return self.position_steady_um <= GOAL_UM and self.angle_steady_urad <= GOAL_URAD


def verify(robot: Robot, progress: Progress | None = None) -> EngineRuns:
    """Run both engines with the set `initial` less its friction (the paper's Table 1 has none).

    Raises:
        DynamicsError, TrajectoryError: see `compare_engines`.
    """
    values = robot.parameter_sets[PARAMETER_SET].vector.copy()
    values[COULOMB], values[VISCOUS] = 0.0, 0.0
    return compare_engines(robot, values, values, DURATION_S, progress)


def judge(runs: EngineRuns) -> Verdict:
    """Figures of a comparison."""
    position, angle = _lengths(runs.difference)
    tracking = _lengths(runs.model_pose - runs.reference)
    steady = runs.time >= STEADY_FROM_S
    return Verdict(
        position_max_um=1e6 * position.max(),
        position_steady_um=1e6 * position[steady].max(),
        angle_max_urad=1e6 * angle.max(),
        angle_steady_urad=1e6 * angle[steady].max(),
        torque_max_nm=float(np.abs(runs.mujoco_torque - runs.model_torque).max()),
        closure_max_um=1e6 * runs.closure.max(),
        spin_max_rad_s=float(runs.spin.max()),
        tracking_max_um=1e6 * tracking[0].max(),
        tracking_max_urad=1e6 * tracking[1].max(),
    )


def verification_entry(robot: Robot, runs: EngineRuns) -> dict[str, Any]:
    """What `verification.json` holds."""
    verdict = judge(runs)
    chosen = robot.parameter_sets[PARAMETER_SET]
    gains = dict(zip(("lp", "li", "ld"), chosen.joint_pid.tolist(), strict=True))
    return {
        "robot": robot.name,
        "parameters": f"{PARAMETER_SET}, friction zero",
        "joint_pid": gains,
        "duration_s": float(runs.time[-1]),
        "steady_from_s": STEADY_FROM_S,
        "mujoco": {
            "version": runs.mujoco_version,
            **asdict(SOLVER),
            "inertias_changed": grouped(physical_inertias(chosen.dynamic, allow_changes=True).changes),
        },
        "difference": asdict(verdict),
        "goal": {"position_steady_um": GOAL_UM, "angle_steady_urad": GOAL_URAD},
        "met": verdict.met,
        "paper": PAPER,
    }


def _lengths(difference: Array) -> tuple[Array, Array]:
    """Lengths (N,) of the position part and of the angle part of pose differences (N, 6)."""
    return np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)
