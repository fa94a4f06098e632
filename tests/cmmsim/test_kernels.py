"""The compiled kernels against plain numpy and against themselves uncompiled; where their cache lies."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cmmsim
from cmmsim.detection import ellipse_fit
from cmmsim.detection import fit_kernels as fit_kernel
from cmmsim.geometry import disc_kernels as blur_kernel
from cmmsim.geometry import disc_kernels as coverage_kernel
from cmmsim.geometry import point_kernels as cholesky_kernel
from cmmsim.geometry.disc_image import blurred_coverage, coverage
from tests.cmmsim import numpy_blurred_coverage, numpy_coverage, numpy_fit
from tests.cmmsim.ellipses import NOISE, random_ellipses

SIZE = 16


@pytest.mark.parametrize("radii", [(3.8, 2.4), (0.2, 0.1), (0.5, 9.0), (1.0, 1.0), (30.0, 30.0)])
def test_coverage_is_that_of_plain_numpy(radii):
    """In all cases of a side: within, outside, crossed once or twice; centres on pixel corners are among them."""
    centres, shapes = random_ellipses(np.random.default_rng(0), 50, SIZE, radii)
    centres[:10] = np.round(2.0 * centres[:10]) / 2.0
    for found, expected in zip(
        coverage(centres, shapes, SIZE), numpy_coverage.coverage(centres, shapes, SIZE), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=2e-12)


@pytest.mark.parametrize("psf_px", [0.2, 0.5, 1.5])
def test_blurred_coverage_is_that_of_plain_numpy(psf_px):
    centres, shapes = random_ellipses(np.random.default_rng(1), 20, SIZE)
    for found, expected in zip(
        blurred_coverage(centres, shapes, SIZE, psf_px),
        numpy_blurred_coverage.blurred_coverage(centres, shapes, SIZE, psf_px),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, atol=1e-7)


def exposed(seed, count, radii=(3.8, 2.4)):
    rng = np.random.default_rng(seed)
    centres, shapes = random_ellipses(rng, count, SIZE, radii)
    radiance = (8.0 + 220.0 * coverage(centres, shapes, SIZE)[0]) / 255.0
    return NOISE.expose(radiance.astype(np.float32), rng), np.tile([1000, 700], (count, 1))


@pytest.mark.parametrize("radii", [(3.8, 2.4), (2.2, 1.8), (5.0, 4.9)])
def test_fit_takes_the_steps_of_plain_numpy(monkeypatch, radii):
    monkeypatch.setattr(ellipse_fit, "CONVERGED_PX", 0.0)
    windows, corners = exposed(2, 300, radii)
    ours = ellipse_fit.fit_ellipses(windows, corners, NOISE, 14, iterations=3)
    theirs = numpy_fit.fit_ellipses(windows, corners, NOISE, 14, iterations=3)
    np.testing.assert_array_equal(ours.good, theirs.good)
    for name in ("centres", "shapes", "contrast", "misfit"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-9, rtol=1e-9)
    np.testing.assert_allclose(ours.covariances, theirs.covariances, rtol=1e-9, atol=1e-12)


def test_windows_fitted_together_are_those_fitted_alone():
    """A second thread takes half of many windows; which one fits a window changes nothing."""
    windows, corners = exposed(5, 37)
    together = ellipse_fit.fit_ellipses(windows, corners, NOISE, 14)
    for k in range(37):
        alone = ellipse_fit.fit_ellipses(windows[k : k + 1], corners[k : k + 1], NOISE, 14)
        np.testing.assert_array_equal(together.centres[k], alone.centres[0])
        np.testing.assert_array_equal(together.covariances[k], alone.covariances[0])
        assert together.misfit[k] == alone.misfit[0]


def test_fit_stops_no_earlier_than_the_noise_allows():
    """Against twelve steps: nearly all within a hundredth of a standard deviation, and the covariance with them; some
    one in a thousand windows creep, because the share of a pixel has kinks in its second derivatives."""
    windows, corners = exposed(3, 1000)
    ours = ellipse_fit.fit_ellipses(windows, corners, NOISE, 14)
    theirs = numpy_fit.fit_ellipses(windows, corners, NOISE, 14, iterations=12)
    gap, deviation = np.abs(ours.centres - theirs.centres).max(axis=1), np.sqrt(theirs.covariances[:, 0, 0])
    assert np.quantile(gap / deviation, 0.99) < 0.01
    assert np.max(gap / deviation) < 0.3
    np.testing.assert_allclose(ours.covariances[:, 0, 0], theirs.covariances[:, 0, 0], rtol=5e-3)


def test_windows_without_an_ellipse_give_finite_numbers():
    flat = np.zeros((3, SIZE, SIZE))
    flat[1], flat[2, 3, 3] = 255.0, 255.0
    fits = ellipse_fit.fit_ellipses(flat, np.zeros((3, 2), dtype=int), NOISE, 14)
    assert not fits.good.any()
    for name in ("centres", "covariances", "shapes", "shape_covariances", "contrast", "misfit"):
        assert np.isfinite(getattr(fits, name)).all()


def test_kernels_compute_the_same_uncompiled():
    centres, shapes = random_ellipses(np.random.default_rng(4), 1, SIZE)
    for kernel, more in ((coverage_kernel.cover_window, ()), (blur_kernel.blur_window, (0.6,))):
        results = []
        for function in (kernel, kernel.py_func):
            shares, derivatives = np.empty((SIZE, SIZE)), np.empty((SIZE, SIZE, 5))
            function(*centres[0], shapes[0], *more, shares, derivatives)
            results.append(np.dstack([shares, derivatives]))
        np.testing.assert_allclose(*results, atol=1e-13)
    m = np.linalg.inv(shapes[0])
    for x, y in ((0.2, 0.1), (3.0, 1.0), (2.2, -2.0), (9.0, 9.0)):
        np.testing.assert_allclose(
            coverage_kernel.cover_pixel(x, y, m), coverage_kernel.cover_pixel.py_func(x, y, m), atol=1e-14
        )
    sides = np.random.default_rng(5).normal(size=(200, 4))
    for side in sides:
        np.testing.assert_allclose(
            coverage_kernel.side_share(*side), coverage_kernel.side_share.py_func(*side), atol=1e-14
        )


def test_small_linear_algebra_is_that_of_lapack():
    rng = np.random.default_rng(6)
    half, right = rng.normal(size=(9, 7)), rng.normal(size=7)
    k = cholesky_kernel
    for factor, solve, invert in (
        (k.factor, k.solve_factored, k.invert_factored),
        (k.factor.py_func, k.solve_factored.py_func, k.invert_factored.py_func),
    ):
        lower, found, inverse = half.T @ half, right.copy(), np.empty((2, 2))
        factor(lower)
        solve(lower, found)
        invert(lower, inverse)
        np.testing.assert_allclose(inverse, np.linalg.inv(half.T @ half)[:2, :2], rtol=1e-9)
        np.testing.assert_allclose(np.tril(lower), np.linalg.cholesky(half.T @ half), rtol=1e-9)
        np.testing.assert_allclose(found, np.linalg.solve(half.T @ half, right), rtol=1e-9)


def test_selection_and_bounded_radii():
    rng = np.random.default_rng(7)
    for count in (1, 2, 7, 256):
        values = rng.integers(0, 30, count).astype(float)
        for n in {0, count // 3, count - 1}:
            assert fit_kernel.nth_smallest(values.copy(), n) == np.sort(values)[n]
    matrix = np.array([[4.0, 1.5], [1.5, 0.9]])
    xx, xy, yy = fit_kernel.bound_radii(4.0, 1.5, 0.9, 0.5, 3.0)
    values, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose([[xx, xy], [xy, yy]], vectors @ np.diag(np.clip(values, 0.5, 3.0)) @ vectors.T)


PROBE = (
    "import numpy as np; from cmmsim.geometry.disc_image import covered_area as c;"
    "print(c(np.full((1, 2), 5.2), np.eye(2)[None] * 3.0, 12).sum())"
)


def run_copy(folder, environment):
    return subprocess.run(
        [sys.executable, "-c", PROBE],
        cwd=folder,
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
        text=True,
    ).stdout


@pytest.fixture
def copied(tmp_path):
    """A folder with a copy of the package, without any compiled kernel."""
    shutil.copytree(
        Path(cmmsim.__file__).parent, tmp_path / "install" / "cmmsim", ignore=shutil.ignore_patterns("__pycache__")
    )
    return tmp_path / "install"


@pytest.mark.slow
def test_kernel_is_compiled_anew_when_one_that_it_calls_changes(copied):
    before = float(run_copy(copied, {}))
    index = copied / "cmmsim" / "__pycache__"
    kept = {p: p.stat().st_mtime_ns for p in index.glob("*.nbi")}
    assert kept
    assert float(run_copy(copied, {})) == before
    assert {p: p.stat().st_mtime_ns for p in index.glob("*.nbi")} == kept
    callee = copied / "cmmsim" / "fit_kernel.py"  # any kernel counts, whether called or not
    callee.write_text(callee.read_text() + "\n")
    run_copy(copied, {})
    assert {p: p.stat().st_mtime_ns for p in kept} != kept


@pytest.mark.slow
def test_kernels_compile_where_the_package_cannot_be_written(copied, tmp_path):
    """The cache goes to the user's folder; without one they are compiled in every process."""
    if os.geteuid() == 0:
        (copied / "cmmsim" / "__pycache__").write_text("")  # root may write anywhere, but not into a file
    else:
        (copied / "cmmsim").chmod(0o555)
    home = {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home")}
    assert float(run_copy(copied, home)) == pytest.approx(9.0 * np.pi)
    assert list((tmp_path / "home").rglob("coverage_kernel*.nbi"))
    (tmp_path / "nowhere").write_text("")
    nowhere = {"HOME": str(tmp_path / "nowhere"), "XDG_CACHE_HOME": str(tmp_path / "nowhere")}
    assert float(run_copy(copied, nowhere)) == pytest.approx(9.0 * np.pi)


def test_importing_the_package_does_not_import_the_compiler():
    code = "import sys, cmmsim; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
