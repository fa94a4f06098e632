"""``cmmsim acceptance``: what it writes, what it prints, and what it refuses before it draws anything."""

import json

import pytest

from identify.verification.acceptance_report import acceptance_markdown
from tests.identify.commands import command


@pytest.fixture
def nothing_is_drawn(monkeypatch):
    def drawn(*_):
        raise AssertionError("the tests have begun")

    monkeypatch.setattr("identify.verification.acceptance.do", drawn)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ctrak"], "unknown sensor 'ctrak'"),
        (["--renderer", "oil"], "unknown renderer 'oil': valid are analytic"),
        (["--standard", "iso"], "unknown standard 'iso': valid are all, e3064, e3124, vdi"),
        (["--limit-um", "0"], "positive number of um, got 0"),
        (["--limit-um", "nan"], "positive number of um, got nan"),
        (["--volume", "big"], "volume 'big' is neither"),
        (["--volume", "1x2"], "volume '1x2' is neither"),
        (["--volume", "nan"], "volume 'nan' is neither"),
        (["--volume", "3"], "measuring volume 3000 x 3000 x 3000 mm is not wholly visible to both cameras"),
        (["--volume", "0.6x0.3x0.3"], "two thirds"),
        (["--volume", "0.3", "--standard", "e3064"], "the bar needs"),
        (["--volume", "0.3", "--standard", "e3124"], "the body on its circle needs"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_drawn(nothing_is_drawn, tmp_path, capsys, arguments, message):
    out = tmp_path / "out"
    assert command("acceptance", *arguments, "--out", out) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not out.exists()


def test_bad_folders_are_refused_before_anything_is_drawn(nothing_is_drawn, tmp_path, capsys):
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "file").write_text("x")
    (tmp_path / "file").write_text("x")
    for out, message in (("used", "is not empty"), ("file", "is a file"), ("file/deeper", "cannot be made")):
        assert command("acceptance", "--renderer", "analytic", "--out", tmp_path / out) == 1
        assert message in capsys.readouterr().err


def test_help_teaches(capsys):
    assert command("acceptance", "--help") == 0
    text = capsys.readouterr().out
    for word in ("vdi", "e3064", "e3124", "--volume", "--limit-um", "cmmsim acceptance mine.toml"):
        assert word in text


@pytest.fixture(scope="module")
def lengths(tmp_path_factory):
    """The length test alone, with a limit that no sensor keeps."""
    out = tmp_path_factory.mktemp("acceptance") / "out"
    status = command(
        "acceptance", "--standard", "vdi", "--renderer", "analytic", "--limit-um", "0.01", "--out", out, "--quiet"
    )
    return status, out


def test_missed_limit_is_reported_and_written(lengths, capsys):
    status, out = lengths
    assert status == 1
    entry = json.loads((out / "acceptance.json").read_text(encoding="utf-8"))
    test = entry["vdi_2634_1"]
    assert test["met"] is False
    errors = [length["error_um"] for line in test["lines"] for length in line["lengths"]]
    assert len(errors) == 35
    assert abs(test["largest_error_um"]) == max(map(abs, errors))
    for line in test["lines"]:
        for length in line["lengths"]:
            assert 1e3 * (length["measured_mm"] - length["certified_mm"]) == pytest.approx(length["error_um"], abs=1e-6)
    assert "astm_e3064" not in entry
    assert "MISSED" in (out / "acceptance.md").read_text(encoding="utf-8")
    assert {path.name for path in (out / "figures").iterdir()} == {"length_errors.png", "measuring_lines.png"}


def test_tables_stand_beside_the_published_figures(lengths):
    _, out = lengths
    entry = json.loads((out / "acceptance.json").read_text(encoding="utf-8"))
    text = acceptance_markdown(entry)
    assert text == (out / "acceptance.md").read_text(encoding="utf-8")
    for row in (
        "| position, static | Creaform C-Track 780 | 0.05 mm |",
        "| latency | NDI Polaris Vega | 14.2 ms |",
        "| position, moving | NIST, 12 cameras | 0.2 mm |",
        "| position, static | Vicon | 0.15 mm |",
    ):
        assert row in text
    assert "What is not:" in text


@pytest.mark.slow
def test_whole_acceptance_of_the_built_in_sensor(tmp_path, capsys):
    """All three tests keep the limit; statistics are consistent and the errors are as large as stated."""
    out = tmp_path / "out"
    assert command("acceptance", "--renderer", "analytic", "--out", out) == 0
    shown = capsys.readouterr().out
    assert "length error" in shown
    assert "moving bar" in shown
    assert "latency" in shown
    entry = json.loads((out / "acceptance.json").read_text(encoding="utf-8"))
    assert entry["vdi_2634_1"]["met"] is True
    bar = entry["astm_e3064"]
    assert bar["lost_frames"] == 0
    assert 0.9 < bar["variance_ratio"] < 1.1
    for state in ("standing", "moving"):
        for figures in bar[state].values():
            assert figures["mean"] < figures["rms"] < figures["p95"] < figures["maximum"]
            assert figures["interval"]["rms"][0] < figures["rms"] < figures["interval"]["rms"][1]
    latency = entry["astm_e3124"]
    assert latency["mean_interval_ms"][0] <= latency["sensor_file_ms"] <= latency["mean_interval_ms"][1]
    assert {path.name for path in (out / "figures").iterdir()} == {
        "measuring_lines.png",
        "length_errors.png",
        "bar_paths.png",
        "bar_errors.png",
        "latency.png",
    }
