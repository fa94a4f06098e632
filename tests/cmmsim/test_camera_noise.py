"""The camera's noise recovered from its images, after EMVA 1288: photon transfer, PRNU, DSNU; bit
depth, saturation.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

import cmmsim
from cmmsim.files.sensor_file import read_sensor_file, sensor_text
from cmmsim.radiometry.noise import CameraNoise, FixedPattern, draw_pattern
from tests.cmmsim.sensors import NOISE, exact

GAIN, DARK_NOISE, WHITE, BLACK = 0.13, 26.0, 1600.0, 16.0
CORNERS = np.array([[[200 + 400 * i, 150 + 300 * j] for i in range(4) for j in range(4)]] * 2)
SIZE = 60


def lit_evenly(level, seed=0, changes=None):
    """Windows (2, 16, SIZE, SIZE) of a wall of one level that fills both images; one call is one
    exposure.
    """
    sensor = exact("perfect", {"stickers.obstacle_level": level} | (changes or {}), seed=seed)
    sensor.add_bodies({"wall": trimesh.creation.box(extents=(0.1, 4.0, 4.0))})
    place = np.eye(4)
    place[:3, 3] = [0.9, 0.0, 0.76]
    place[:3, :3] = cmmsim.rod_transform([0, 0, 0], [0.72, 0.0, 0.69])[:3, :3] @ [
        [0, 0, 1],
        [0, 1, 0],
        [-1, 0, 0],
    ]
    return lambda: sensor.look(sensor.home, {"wall": place}).windows(CORNERS, SIZE).astype(float)


@pytest.mark.parametrize("bits", [8, 12])
def test_noise_in_percent_of_white_is_that_of_dark_pixels(bits):
    """One per cent of the largest grey value, on a black wall without light to scatter."""
    gain = GAIN * 2 ** (bits - 8)
    white = 2**bits - 1
    look = lit_evenly(
        0.0,
        changes={
            "camera.grey_noise_percent": 1.0,
            "camera.bit_depth": bits,
            "camera.gain": gain,
            "camera.black_level": 0.2 * white,
            "camera.noise": True,
        },
    )
    assert look().std() / white == pytest.approx(0.01, rel=0.05)
    with pytest.raises(cmmsim.CmmError, match="grey_noise_percent"):
        cmmsim.load_sensor("ctrack780", 0, {"camera.grey_noise_percent": -1.0})


def test_dark_noise_beside_a_percentage_is_refused_and_one_of_them_suffices(tmp_path):
    """In a file, in its changes, in both, and in a file that is based on another."""
    text, both = sensor_text("ctrack780"), tmp_path / "both.toml"
    both.write_text(text.replace("# grey_noise_percent", "grey_noise_percent"))
    percent = tmp_path / "percent.toml"
    percent.write_text(both.read_text().replace("dark_noise = 26.0", ""))
    based = tmp_path / "based.toml"
    based.write_text('name = "b"\nbased_on = "percent.toml"\n[camera]\ndark_noise = 9.0\n')
    dark, grey = {"camera.dark_noise": 9.0}, {"camera": {"grey_noise_percent": 2.0}}
    for file, changes in ((both, {}), (based, {}), (percent, dark), ("ctrack780", dark | grey)):
        with pytest.raises(cmmsim.CmmError, match=r"dark_noise = .* does nothing beside"):
            read_sensor_file(file, changes)
    assert read_sensor_file(percent).camera.dark_noise == pytest.approx(1.33 / 100 * 255 / GAIN)
    assert read_sensor_file("ctrack780", grey).camera.dark_noise == pytest.approx(5.1 / GAIN)


def test_photon_transfer_gives_gain_and_dark_noise():
    """The variance of a pixel's grey value grows with its mean by the gain K; what the dark has is
    the dark noise.
    """
    means, variances = [], []
    for level in (0, 40, 90, 140, 190, 230):
        expose = lit_evenly(level)
        first, second = expose(), expose()
        means.append(0.5 * (first + second).mean())
        # the difference frees it from what differs between pixels
        variances.append(0.5 * (first - second).var())
    gain, dark = np.polyfit(np.array(means) - BLACK, variances, 1)
    assert gain == pytest.approx(GAIN, rel=0.03)
    assert np.sqrt(variances[0] - 1.0 / 12.0) / gain == pytest.approx(DARK_NOISE, rel=0.03)
    assert np.sqrt(dark - 1.0 / 12.0) / gain == pytest.approx(DARK_NOISE, rel=0.03)
    np.testing.assert_allclose(
        means, BLACK + GAIN * WHITE * np.array([0, 40, 90, 140, 190, 230]) / 255.0, atol=0.1
    )


@pytest.mark.parametrize("deviation", [0.01, 0.1, 0.3, 0.5, 1.0, 3.0])
def test_rounding_excess_is_the_largest_variance_of_rounded_numbers(deviation):
    """Against the probabilities of the numbers, over means everywhere between two of them."""
    noise = CameraNoise(1e6, 1e-4, deviation / 1e-4, 2e6, 0.0)
    means, numbers = np.linspace(100.0, 101.0, 201)[:, None], np.arange(60, 142)
    probability = norm.cdf(numbers + 0.5, means, deviation) - norm.cdf(
        numbers - 0.5, means, deviation
    )
    variance = (probability * numbers**2).sum(axis=1) - (probability * numbers).sum(axis=1) ** 2
    expected = variance.max() / (deviation**2 + 1.0 / 12.0)
    assert noise.rounding_excess(np.array(0.0)) == pytest.approx(expected, rel=0.01)
    assert replace(noise, frames=9).rounding_excess(np.array(0.0)) == pytest.approx(
        expected, rel=0.01
    )


@pytest.mark.slow
def test_pattern_is_recovered_from_averaged_images():
    """PRNU from a bright and DSNU from a dark level: spatial variance of the mean less what the
    averaging leaves.
    """
    spatial = {}
    for level in (0, 200):
        expose = lit_evenly(level, changes={"camera.prnu": 0.02, "camera.dsnu": 15.0})
        stack = np.stack([expose()[0] for _ in range(40)])
        spatial[level] = stack.mean(axis=0).var() - stack.var(axis=0, ddof=1).mean() / 40.0
    assert np.sqrt(spatial[0]) / GAIN == pytest.approx(15.0, rel=0.04)
    electrons = WHITE * 200.0 / 255.0
    assert np.sqrt(spatial[200] - spatial[0]) / GAIN / electrons == pytest.approx(0.02, rel=0.04)


@pytest.mark.slow
def test_pattern_stays_and_belongs_to_the_camera():
    """The same in windows and whole images and for other noise; another one for the other camera
    and pattern seed.
    """

    def pattern(seed, pattern_seed):
        expose = lit_evenly(0, seed, {"camera.dsnu": 60.0, "camera.pattern_seed": pattern_seed})
        return np.mean([expose() for _ in range(6)], axis=0)

    def alike(one, other):
        return np.corrcoef(one.ravel(), other.ravel())[0, 1]

    given = pattern(0, 0)
    assert alike(given[0], pattern(5, 0)[0]) > 0.9
    assert abs(alike(given[0], given[1])) < 0.03
    assert abs(alike(given[0], pattern(0, 1)[0])) < 0.03
    sensor = exact("perfect", {"camera.dsnu": 60.0, "stickers.body_level": 0})
    frame = sensor.capture(sensor.home)
    x, y = CORNERS[0, -1]
    assert alike(given[0, -1], frame.left[y : y + SIZE, x : x + SIZE].astype(float)) > 0.8


def test_windows_of_a_pattern_are_cut_out_of_it():
    whole = draw_pattern((90, 120), 0.01, 5.0, np.random.default_rng(0))
    cut = whole.windows(np.array([[10, 20], [110, 85]]), 16)
    np.testing.assert_array_equal(cut.sensitivity[0], whole.sensitivity[20:36, 10:26])
    np.testing.assert_array_equal(cut.offset[1, :5, :10], whole.offset[85:, 110:])
    assert np.all(cut.offset[1, 5:, 10:] == whole.offset[-1, -1])


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_bit_depth_and_saturation(bits):
    scale = 2 ** (bits - 8)
    noise = CameraNoise(WHITE, GAIN * scale, DARK_NOISE, 1e6, BLACK * scale, bit_depth=bits)
    image = noise.expose(np.full((50, 50), 2.0, dtype=np.float32), np.random.default_rng(0))
    assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.all(image == 2**bits - 1)
    half = noise.expose(
        np.full((300, 300), 0.5, dtype=np.float32), np.random.default_rng(0)
    ).astype(float)
    assert half.mean() == pytest.approx((BLACK + 0.5 * GAIN * WHITE) * scale, rel=1e-3)
    assert half.var() == pytest.approx(noise.variance(half.mean()), rel=0.03)
    full = CameraNoise(WHITE, GAIN * scale, DARK_NOISE, 900.0, BLACK * scale, bit_depth=bits)
    assert full.mean_grey(np.array(1.0)) == pytest.approx((BLACK + GAIN * 900.0) * scale)


def test_grey_values_are_those_of_the_model_in_plain_numpy():
    """With the same stream: electrons up to the full well, shot and dark noise, offset, gain,
    limits.
    """
    noise = replace(NOISE, full_well=900.0, prnu=0.05, dsnu=12.0, bit_depth=10, black_level=60.0)
    radiance = np.random.default_rng(5).random((3, 40, 50), dtype=np.float32)
    pattern = draw_pattern(radiance.shape, noise.prnu, noise.dsnu, np.random.default_rng(6))
    for differing in (None, pattern):
        seen, offset = (1.0, 0.0) if differing is None else (pattern.sensitivity, pattern.offset)
        electrons = np.minimum(radiance.astype(float) * WHITE * seen, 900.0)
        drawn = np.random.default_rng(7).standard_normal(radiance.shape, dtype=np.float32)
        value = 60.0 + GAIN * (electrons + drawn * np.sqrt(electrons + DARK_NOISE**2) + offset)
        found = noise.expose(radiance, np.random.default_rng(7), differing).astype(float)
        whole = np.abs(value - np.floor(value) - 0.5) > 1e-3  # elsewhere single precision decides
        np.testing.assert_array_equal(found[whole], np.clip(np.rint(value), 0.0, 1023.0)[whole])


# the one taken one by one, the other drawn at once
@pytest.mark.parametrize("exposures", [25, 400])
def test_averaging_reduces_what_changes_but_not_the_pattern(exposures):
    """The variance of averaged exposures over many patterns, sampled, is as stated."""
    noise = replace(NOISE, full_well=1e6, prnu=0.02, dsnu=10.0, frames=exposures)
    radiance, rng = np.full((200, 200), 0.6, dtype=np.float32), np.random.default_rng(1)
    pattern = draw_pattern(radiance.shape, noise.prnu, noise.dsnu, rng)
    grey = noise.mean_of_exposures(radiance, rng, exposures, pattern)
    assert grey.var() == pytest.approx(noise.variance(grey.mean()), rel=0.03)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, id="usual"),
        pytest.param({"bit_depth": 12, "gain": 2.08, "black_level": 256.0}, id="12 bit"),
        pytest.param({"black_level": 1.0}, id="dark"),
        pytest.param(
            {"bit_depth": 12, "gain": 2.08, "black_level": 0.0, "full_well": 900.0},
            id="12 bit dark, full",
        ),
        pytest.param({"gain": 0.2, "full_well": 1e4}, id="saturated"),
        pytest.param(
            {"electrons_at_white": 1e6, "full_well": 2e6, "gain": 2e-4, "dark_noise": 0.0},
            id="no dark noise",
        ),
        pytest.param(
            {"electrons_at_white": 1e6, "full_well": 2e6, "gain": 2e-4, "dark_noise": 2e3},
            id="little noise",
        ),
    ],
)
@pytest.mark.parametrize("differing", [False, True])
@pytest.mark.parametrize("count", [10_000, pytest.param(100_000, marks=pytest.mark.thorough)])
def test_a_mean_drawn_at_once_has_the_mean_and_variance_of_averaged_exposures(
    changes, differing, count
):
    """Against many exposures of pixels of 25 levels, to 4.5 standard deviations, which chance
    alone passes in 5 of 1,000 runs of these 700 comparisons; what happens less than 5 times in all
    exposures is not seen."""
    noise, frames = replace(NOISE, **changes), 40
    rng = np.random.default_rng(3)
    levels = np.concatenate([np.zeros(1), rng.uniform(0.0, 1.3, 24)]).astype(np.float32)
    pixels = draw_pattern(levels.shape, 0.03, 0.5 / noise.gain, rng)
    pattern = FixedPattern(*(np.tile(v, (count, 1)) for v in (pixels.sensitivity, pixels.offset)))
    radiance = np.tile(levels, (count, 1))
    single = noise.expose(radiance, rng, pattern if differing else None).astype(float)
    mean = noise.mean_of_exposures(radiance, rng, frames, pattern if differing else None)
    variance, drawn = single.var(axis=0), frames * mean.var(axis=0)
    unseen = 5.0 / count
    error = np.sqrt(variance / count * (1.0 + 1.0 / frames))
    assert np.all(np.abs(mean.mean(axis=0) - single.mean(axis=0)) <= 4.5 * error + unseen)
    fourth = ((single - single.mean(axis=0)) ** 4).mean(axis=0)
    error = np.sqrt((fourth - variance**2 + 2.0 * drawn**2) / count)
    assert np.all(np.abs(drawn - variance) <= 4.5 * error + unseen)


def test_pixels_without_noise_keep_their_rounded_value_in_the_mean():
    noise = replace(NOISE, dark_noise=0.0, black_level=16.5)
    dark = np.zeros((3, 4), dtype=np.float32)
    drawn = noise.mean_of_exposures(dark, np.random.default_rng(0), 100)
    np.testing.assert_array_equal(drawn, noise.expose(dark, np.random.default_rng(1)))
