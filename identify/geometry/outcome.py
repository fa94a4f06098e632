"""Outcome of a geometry calibration, and its files."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dynamics.robot_file import RobotDescription
from dynamics.robot_text import robot_text
from identify.arrays import Array
from identify.files.dataset import covariance_netcdf
from identify.files.digest import toml_with_digest
from identify.files.run_folder import rms_figures, save_files
from identify.files.versions import versions
from identify.geometry.calibration import Calibration, PoseModel, frame_columns, measured_poses
from identify.geometry.observability import combinations
from identify.geometry.pose_selection import Candidates
from identify.geometry.static_experiment import true_poses
from identify.geometry.static_poses import StaticPoses
from identify.scenario import Scenario

CURVE = 12  # largest number of entries in the list of expected errors after random poses
NOISY = 4.0  # excess of the noise ratio, in standard deviations, above which a warning is given


@dataclass(frozen=True)
class GeometryOutcome:
    """Calibration with its poses.

    scenario     Scenario of the calibration.
    seed         Seed of the experiment.
    model        Model of the poses.
    calibration  Estimated geometry.
    data         Measured poses.
    lost_frames  Number of lost frames.
    true (g,)    True deviations in a simulation, or None.
    unseen       Validation poses, which were not measured.
    chosen       Poses chosen for a simulation, or None.
    among        Candidates for the choice of poses.
    """

    scenario: Scenario
    seed: int
    model: PoseModel
    calibration: Calibration
    data: StaticPoses
    lost_frames: int
    true: Array | None
    unseen: Candidates
    chosen: Candidates | None
    among: Candidates

    def write(self, folder: Path, pictures: Mapping[str, Any] | None = None) -> None:
        """Write the files of the outcome into a folder: all files, or none.

        The files are geometry.json, geometry.md, covariance.nc, poses.json, robot.toml and
        scenario.toml. ``pictures`` are the contents of further files by name.
        """
        robot = self.calibration.robot
        description = RobotDescription(robot.name, robot.geometry, robot.parameter_sets)
        said = (
            f"{robot.name} with the geometry of {len(self.data)} static poses; see "
            "geometry.json beside this file"
        )
        files: dict[str, Any] = {
            "geometry.json": self.entry,
            "geometry.md": geometry_markdown(self.entry),
            "poses.json": self.data.entry(robot),
            "robot.toml": toml_with_digest(robot_text(description, [said])),
            "scenario.toml": self.scenario.to_toml(),
            **(pictures or {}),
        }
        units = dict(zip(robot.geometry.number_names, robot.geometry.number_units, strict=True))
        covariance = covariance_netcdf(units, self.calibration.covariance)
        save_files(folder, files | {"covariance.nc": covariance})

    @cached_property
    def entry(self) -> dict[str, Any]:
        """Content of geometry.json."""
        found = self.calibration
        names = self.calibration.nominal.geometry.number_names
        entry: dict[str, Any] = {
            "scenario": self.scenario.name,
            "seed": self.seed,
            "versions": versions(),
            "robot": found.nominal.name,
            "poses": len(self.data),
            "frames_per_pose": self.scenario.geometry.frames_per_pose,
            "lost_frames": self.lost_frames,
            "frames": "taught" if found.frames_known else "unknown",
            "frame_errors": {"base": found.frames[:6], "platform": found.frames[6:]},
            "parameters": self._parameters(),
            "cannot_be_told": list(combinations(names, found.covariance, found.prior_std)),
            "noise_ratio": found.noise_ratio,
            "noise_ratio_std": found.noise_ratio_std,
            "warnings": self._warnings(),
            **self._judged(),
        }
        if self.chosen is not None:
            entry["selection"] = self._compared(self.chosen)
            entry["random_poses"] = self._by_count(2 * len(self.chosen))
        return entry

    def _parameters(self) -> dict[str, dict[str, Any]]:
        found = self.calibration
        geometry = self.calibration.nominal.geometry
        true = (
            [None] * len(geometry.numbers)
            if self.true is None
            else (geometry.numbers + self.true).tolist()
        )
        columns = {
            "unit": geometry.number_units,
            "nominal": geometry.numbers.tolist(),
            "true": true,
            "estimate": (geometry.numbers + found.deviations).tolist(),
            "std": found.std.tolist(),
            "tolerance": found.prior_std.tolist(),
            "observable": found.observable.tolist(),
        }
        rows = zip(*columns.values(), strict=True)
        return {
            name: dict(zip(columns, row, strict=True))
            for name, row in zip(geometry.number_names, rows, strict=True)
        }

    def _warnings(self) -> list[str]:
        found = self.calibration
        said = []
        off = (found.noise_ratio - 1) / found.noise_ratio_std
        if off > NOISY:
            said.append(
                f"the residuals of the poses are {np.sqrt(found.noise_ratio):.2f} times the stated "
                f"noise of sensor and encoders ({off:.0f} standard deviations more than chance): "
                "the intervals are too short, or the robot differs from the model of "
                f"{found.nominal.name}, for example by elastic legs or play in joints"
            )
        missing = 0 if self.chosen is None else len(self.chosen) - len(self.data)
        if missing:
            said.append(
                f"{missing} of {missing + len(self.data)} poses are left out: the sensor lost all "
                "their frames"
            )
        return said

    def _judged(self) -> dict[str, Any]:
        """Return errors of the validation poses: expected, and true ones if they are known."""
        found = self.calibration
        robot = self.calibration.nominal
        closure = self.model.closure
        joints = self.unseen.joints
        poses = self.unseen.poses
        columns = closure.derivatives(poses, joints, found.deviations)[0]
        covariance = found.covariance
        if not found.frames_known:
            # Errors of geometry and frames are then correlated, so both are included.
            of_frames = frame_columns(robot, poses)[:, list(robot.geometry.chart.freedoms)]
            columns = np.concatenate([columns, of_frames], axis=2)
            covariance = found.joint_covariance
        judged = {"expected": self._spread(columns, covariance)}
        if self.true is None:
            # Without the truth these errors are unknown. NaN becomes null in the file.
            return judged | {"unseen": rms_figures(np.full((1, 6), np.nan))}
        actual = true_poses(robot, self.true, joints, poses)
        predicted = measured_poses(closure.poses(joints, found.deviations, poses), found.frames)
        return judged | {
            "unseen": rms_figures(predicted - actual),
            "uncalibrated": rms_figures(poses - actual),
        }

    def _compared(self, chosen: Candidates) -> dict[str, Any]:
        """Return expected errors of validation poses after chosen poses and after random poses."""
        count = len(chosen)
        sets = {"chosen": chosen, "random": self.among.of(list(range(count)))}
        if len(self.among) >= 2 * count:
            sets["twice as many random"] = self.among.of(list(range(2 * count)))
        return {name: self._left_by(one) for name, one in sets.items()}

    def _by_count(self, most: int) -> list[dict[str, Any]]:
        """Return expected errors of validation poses after several numbers of random poses.

        The largest number is `most`, or that of the candidates if there are fewer.
        """
        rows = len(self.calibration.nominal.coordinate_names)
        fewest = -(-len(self.calibration.deviations) // rows)
        largest = max(fewest, min(most, len(self.among)))
        counts = np.unique(np.geomspace(fewest, largest, CURVE).astype(int))
        return [self._left_by(self.among.of(list(range(count)))) for count in counts.tolist()]

    def _left_by(self, poses: Candidates) -> dict[str, Any]:
        columns = self.model.columns(
            self.unseen.joints, self.unseen.poses, np.zeros(len(self.model.scale))
        )[0]
        return {"poses": len(poses)} | self._spread(
            columns, np.asarray(np.linalg.inv(poses.with_prior), dtype=float)
        )

    def _spread(self, columns: Array, covariance: Array) -> dict[str, list[float]]:
        """Return expected RMS errors for columns (N, m, u) and a covariance (u, u) of unknowns."""
        std = np.sqrt(np.einsum("nmu,uv,nmv->nm", columns, covariance, columns))
        return rms_figures(self.calibration.nominal.geometry.chart.lifted(std))


def geometry_markdown(entry: dict[str, Any]) -> str:
    """Return the result as text and a table, in Markdown."""
    told = [name for name, one in entry["parameters"].items() if one["observable"]]
    lines = [
        f"# Geometry of {entry['robot']}",
        "",
        f"From {entry['poses']} static poses of {entry['frames_per_pose']} frames each; "
        f"{entry['lost_frames']} frames were lost. The poses determine {len(told)} of "
        f"{len(entry['parameters'])} geometric numbers; the others keep the values of the robot "
        "file, with the stated tolerance.",
        "",
        f"Residuals are {np.sqrt(entry['noise_ratio']):.3f} times the stated noise of sensor and "
        "encoders.",
    ]
    lines += [f"\nWarning: {text}." for text in entry["warnings"]]
    said = {
        "uncalibrated": "Error of validation poses before the calibration",
        "unseen": "Error of validation poses after the calibration",
        "expected": "Expected error from the covariance of the geometry",
    }
    figures = {
        f"{text} (root mean square)": entry[key] for key, text in said.items() if key in entry
    }
    names = {
        "chosen": "chosen poses",
        "random": "random poses",
        "twice as many random": "random poses",
    }
    for key, one in entry.get("selection", {}).items():
        figures[
            f"Expected error after {one['poses']} {names[key]}, without the error of teaching"
        ] = one
    for text, one in figures.items():
        if np.isfinite(one["position_rms_um"]).all():
            lines += ["", f"{text}: {_figures(one)}."]
    lines += [
        "",
        "| number | nominal | true | estimate | standard deviation | determined |",
        "|---|--:|--:|--:|--:|---|",
    ]
    for name, one in entry["parameters"].items():
        values = [
            "" if one[key] is None else f"{1e3 * one[key]:.4f}"
            for key in ("nominal", "true", "estimate", "std")
        ]
        lines.append(
            f"| {name} [m{one['unit']}] | {' | '.join(values)} | "
            f"{'yes' if one['observable'] else 'no'} |"
        )
    if entry["cannot_be_told"]:
        lines += [
            "",
            "Combinations that these poses do not determine (the poses hardly change if the "
            "numbers change together):",
            "",
        ]
        lines += [f"- {text}" for text in entry["cannot_be_told"]]
        if entry["frames"] == "unknown":
            lines += [
                "",
                "The frames of base and platform were unknown: these combinations include their "
                "poses.",
            ]
    return "\n".join(lines) + "\n"


def _figures(figures: dict[str, Any]) -> str:
    position, turn = (
        ", ".join(f"{value:.2f}" for value in figures[key])
        for key in ("position_rms_um", "orientation_rms_urad")
    )
    return f"{position} um in x, y, z and {turn} urad in alpha, beta, gamma"
