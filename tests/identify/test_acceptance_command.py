"""``cmmsim acceptance``: what it writes and prints."""

import json
from dataclasses import replace
from functools import partial

import pytest

from cmmsim.acceptance.moving_bar import SECONDS
from identify.commands.help import BEYOND_LIMIT
from identify.verification.acceptance import STANDARDS
from identify.verification.acceptance_report import acceptance_markdown
from tests.identify.commands import command


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(0.5, marks=pytest.mark.thorough),
        pytest.param(SECONDS, marks=pytest.mark.thorough),
    ],
)
def accepted(request, tmp_path_factory):
    """Exit status and folder of all tests with a limit that no sensor keeps; the bar moves for so
    many seconds.
    """
    out, bar = tmp_path_factory.mktemp("acceptance") / "out", STANDARDS["e3064"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            STANDARDS, "e3064", replace(bar, measure=partial(bar.measure, seconds=request.param))
        )
        arguments = ("--renderer", "analytic", "--limit-um", "0.01", "--out", out, "--quiet")
        return command("acceptance", *arguments), out


def read(out):
    return json.loads((out / "acceptance.json").read_text(encoding="utf-8"))


def test_missed_limit_is_the_exit_status_and_all_is_written(accepted):
    status, out = accepted
    assert status == BEYOND_LIMIT
    test = read(out)["vdi_2634_1"]
    assert test["met"] is False
    errors = [length["error_um"] for line in test["lines"] for length in line["lengths"]]
    assert len(errors) == 35
    assert abs(test["largest_error_um"]) == max(map(abs, errors))
    for line in test["lines"]:
        for length in line["lengths"]:
            assert 1e3 * (length["measured_mm"] - length["certified_mm"]) == pytest.approx(
                length["error_um"], abs=1e-6
            )
    text = (out / "acceptance.md").read_text(encoding="utf-8")
    assert "MISSED" in text
    # A hundredth of a micrometre is less than noise: the largest error is within its deviation.
    assert test["advice"]["cause"].startswith(
        "The error is due to noise of the images: the mean of 5"
    )
    assert test["advice"]["command"].startswith("cmmsim acceptance ctrack780 --standard vdi")
    assert f"Next: `{test['advice']['command']}`" in text
    names = [
        "bar_errors.png",
        "bar_paths.png",
        "latency.png",
        "length_errors.png",
        "measuring_lines.png",
    ]
    assert sorted(path.name for path in (out / "figures").iterdir()) == names


def test_statistics_are_consistent_and_tables_stand_beside_the_published_figures(accepted):
    _, out = accepted
    entry, text = read(out), (out / "acceptance.md").read_text(encoding="utf-8")
    assert abs(entry["vdi_2634_1"]["largest_error_um"]) < 50.0  # the limit where none is named
    bar = entry["astm_e3064"]
    assert bar["lost_frames"] == 0
    assert 0.9 < bar["variance_ratio"] < 1.1
    for state in ("standing", "moving"):
        for figures in bar[state].values():
            assert figures["mean"] < figures["rms"] < figures["p95"] < figures["maximum"]
            assert figures["interval"]["rms"][0] < figures["rms"] < figures["interval"]["rms"][1]
    latency = entry["astm_e3124"]
    assert (
        latency["mean_interval_ms"][0]
        <= latency["sensor_file_ms"]
        <= latency["mean_interval_ms"][1]
    )
    assert text == acceptance_markdown(entry)
    for row in (
        "| position, static | Creaform C-Track 780 | 0.05 mm |",
        "| latency | NDI Polaris Vega | 14.2 ms |",
        "| position, moving | NIST, 12 cameras | 0.2 mm |",
        "| position, static | Vicon | 0.15 mm |",
    ):
        assert row in text
    assert "Differences: the published figures are of real instruments" in text


@pytest.mark.slow
def test_one_test_alone_is_summarised_and_writes_only_its_own(tmp_path, capsys):
    out = tmp_path / "out"
    assert command("acceptance", "--standard", "e3124", "--renderer", "analytic", "--out", out) == 0
    shown = capsys.readouterr()
    assert "latency: " in shown.out
    assert "latency (ASTM E3124): 180 of 180" in shown.err
    assert not {"vdi_2634_1", "astm_e3064"} & read(out).keys()
    assert [path.name for path in (out / "figures").iterdir()] == ["latency.png"]
