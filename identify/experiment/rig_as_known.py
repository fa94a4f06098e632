"""Stereo rig as the estimator knows it.

The rig is known exactly, from a calibration with pictures of a board, or with a stated covariance.
The covariance comes from a calibration file, or from a calibration with fifteen photographs. The
true cameras are always those of the sensor file.
"""

import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import cmmsim
from cmmsim.calibration import PairView, board_poses, calibrate, default_board, render_pairs
from cmmsim.calibration.board_detection import find_board
from cmmsim.files import SensorFile
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES, StereoRig
from cmmsim.imaging.renderer import choose_renderer
from cmmsim.radiometry.noise import CameraNoise
from cmmsim.uncertainty.known_rig import PHOTOGRAPHED, KnownRig
from dynamics.files import parse_json, read_text
from identify.arrays import Array
from identify.errors import ScenarioError
from identify.progress import Progress, SilentProgress
from identify.scenario.sections import RIG_KNOWN, Rig

# Largest ratio of focal lengths, or of baselines, at which two rigs count as the same.
LARGEST_RATIO = 1.5
# Largest angle [rad] between right cameras, or between baselines, of two such rigs.
ANGLE = np.deg2rad(10.0)
SHARE = 0.1  # largest distance between their principal points, as a fraction of the image size


def known_rig(
    section: Rig, file: SensorFile, rng: np.random.Generator, progress: Progress | None = None
) -> KnownRig | None:
    """Return the rig of a sensor file as the estimator knows it, according to a scenario's section.

    None means that the rig is known exactly. With `calibrated`, the true cameras take pictures of a
    board, and are calibrated from these pictures. With a path, or `photographs`, the rig is drawn
    at random from the covariance of such a calibration.

    Raises ScenarioError for a file without a calibration, or with a calibration of another rig.
    Raises CalibrationError if the pictures do not determine the cameras.
    """
    rig, _ = rig_from_file(file.rig)
    if section.exact:
        return None
    exposure = section.right_later_std_s
    # The cameras are known exactly, except for the delay of the right camera's exposure.
    if section.known == "exact":
        return KnownRig(rig, np.zeros((len(PARAMETER_NAMES),) * 2), exposure)
    if section.known == "calibrated":
        return replace(
            calibrated_rig(file, section.pairs, rng, progress or SilentProgress()),
            exposure_std=exposure,
        )
    stated = (
        PHOTOGRAPHED
        if section.known == "photographs"
        else stated_covariance(Path(section.known), rig)
    )
    return KnownRig.drawn(rig, stated, rng, exposure)


def warn_of_ignored_covariance(section: Rig, file: SensorFile, name: str) -> None:
    """Warn once if the sensor file ``name`` states a covariance of its cameras that is not used."""
    if section.known == "exact" and file.rig.covariance is not None:
        _warn_of_ignored(name)


@cache
def _warn_of_ignored(name: str) -> None:
    # The stages of one run make several setups, and its user needs one warning.
    warnings.warn(
        f"sensor file {name} states a covariance of its cameras, and rig.known = exact ignores it: "
        "set rig.known to the calibration.json that cmmsim calibrate wrote beside it",
        stacklevel=3,
    )


def calibrated_rig(
    file: SensorFile, pairs: int, rng: np.random.Generator, progress: Progress
) -> KnownRig:
    """Calibrate the rig of a sensor file from pictures of a board of dots.

    The analytic renderer draws the pictures.
    """
    source = cmmsim.Sensor(file, renderer="analytic")
    rig = source.rig
    noise = source.noise
    board = default_board(rig)
    poses = board_poses(rig, board, pairs, rng)
    frames = render_pairs(rig, board, poses, choose_renderer("analytic"), source.optics, noise, rng)
    views = []
    with progress.stage("calibrate the cameras", pairs) as advance:
        for number, frame in enumerate(frames, start=1):
            sides = (
                find_board(_as_read(image, noise), board) for image in (frame.left, frame.right)
            )
            views.append(PairView(f"pair {number}", *sides))
            advance()
    return calibrate(board, views, (rig.left.width, rig.left.height)).known


def _as_read(image: NDArray[np.unsignedinteger[Any]], noise: CameraNoise) -> NDArray[np.uint8]:
    """Return an image (h, w) with 8 bits, like pictures of a board from files."""
    if image.dtype == np.uint8:
        return image
    return np.asarray(np.round(image * (255.0 / noise.white_level)), dtype=np.uint8)


def stated_covariance(path: Path, rig: StereoRig) -> Array:
    """Return the covariance (24, 24) of a rig's parameters from a calibration.json.

    Raises ScenarioError if there is no such file, if it holds no calibration, or if the calibration
    is of another rig. The message states the difference.
    """
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no file"
        inside = path / "calibration.json"
        hint = f"; is {str(inside)!r} meant?" if inside.is_file() else ""
        raise ScenarioError(
            f"rig.known = {str(path)!r} is {what}; valid: {', '.join(RIG_KNOWN)}, or the path of "
            f"the calibration.json of `cmmsim calibrate`{hint}"
        )
    try:
        text = read_text(path, str(path), ScenarioError)
        content = parse_json(text, str(path), ScenarioError)
        names = content["covariance"]["names"]
        matrix = np.array(content["covariance"]["matrix"], dtype=float)
        estimates = np.array(
            [content["parameters"][name]["estimate"] for name in PARAMETER_NAMES], dtype=float
        )
        size = content["image_size_px"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        if isinstance(error, KeyError) and "base_from_camera" in content:
            said = "it is the taught.json of `cmmsim teach`"
        raise ScenarioError(
            f"rig.known = {str(path)!r} is neither exact, calibrated, photographs, nor the "
            f"calibration.json of `cmmsim calibrate`: {said}"
        ) from None
    if list(names) != list(PARAMETER_NAMES) or matrix.shape != (len(PARAMETER_NAMES),) * 2:
        raise ScenarioError(
            f"rig.known = {str(path)!r}: its covariance is not of the {len(PARAMETER_NAMES)} "
            "parameters"
        )
    if size != [rig.left.width, rig.left.height]:
        raise ScenarioError(
            f"rig.known = {str(path)!r} is of cameras with {size} px, but the sensor's cameras "
            f"have {[rig.left.width, rig.left.height]}"
        )
    if not np.isfinite(matrix).all():
        raise ScenarioError(f"rig.known = {str(path)!r}: its covariance is not finite")
    if other := _other_rig(estimates, rig):
        raise ScenarioError(f"rig.known = {str(path)!r} is of another rig: {other}")
    try:
        return KnownRig(rig, matrix).covariance
    except cmmsim.CmmError as error:
        raise ScenarioError(f"rig.known = {str(path)!r}: {error}") from None


def _other_rig(estimates: Array, rig: StereoRig) -> str:
    """Return a difference between calibrated parameters (24,) and a rig, or an empty text."""

    def both(name: str) -> tuple[float, float]:
        index = PARAMETER_NAMES.index(name)
        return float(estimates[index]), float(rig.parameters[index])

    # The last six parameters are translation and rotation vector of right_from_left.
    poses = [(Rotation.from_rotvec(one[21:]), one[18:21]) for one in (estimates, rig.parameters)]
    turned = (poses[0][0].inv() * poses[1][0]).magnitude()
    lengths = [float(np.linalg.norm(baseline)) for _, baseline in poses]
    ratios = {f"{side}.fx_px": both(f"{side}.fx_px") for side in ("left", "right")} | {
        "baseline [m]": tuple(lengths)
    }
    for name, (there, here) in ratios.items():
        if not 1.0 / LARGEST_RATIO < there / here < LARGEST_RATIO:
            return f"{name} is {there:.4g} in the calibration and {here:.4g} in the sensor file"
    for camera in ("left", "right"):
        for name, size in (
            (f"{camera}.cx_px", rig.left.width),
            (f"{camera}.cy_px", rig.left.height),
        ):
            there, here = both(name)
            if not abs(there - here) < SHARE * size:
                return f"{name} is {there:.5g} in the calibration and {here:.5g} in the sensor file"
    swung = np.arccos(np.clip(poses[0][1] @ poses[1][1] / np.prod(lengths), -1.0, 1.0))
    for what, angle in (("right camera", turned), ("baseline", swung)):
        if not angle < ANGLE:
            return (
                f"the direction of the {what}, seen from the left camera, differs by "
                f"{np.rad2deg(angle):.0f} degrees from that in the sensor file"
            )
    return ""
