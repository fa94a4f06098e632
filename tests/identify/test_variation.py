"""Variation of estimates: by hand, and `cmmsim variation` on runs of the reference robot with drawn
noise.
"""

import json
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from identify.errors import EstimationError
from identify.record import recording
from identify.reporting.variation_tables import PAPER_PERCENT, PAPER_WORST_PERCENT, variation_table
from identify.validation.variation import variation
from tests.identify.commands import command, one_line
from tests.identify.run_files import write_runs
from tests.identify.synthetic import LAYOUT, quick, run_plant, short_run

# What every run of the reference robot with an exciting trajectory identifies.
IDENTIFIED = {
    *(f"platform.{name}" for name in ("mass", "Ixx", "Iyy", "Izz")),
    *(f"joint_pid.{name}" for name in ("lp", "li", "ld")),
    *(f"link{leg}.mass" for leg in range(1, 7)),
    *(f"joint{leg}.{law}" for leg in range(1, 7) for law in ("coulomb", "viscous")),
}


def result(estimate, std, identifiable):
    names, columns = (
        ("link1.mass", "joint1.coulomb", "link2.Ixx"),
        map(np.array, (estimate, std, identifiable)),
    )
    layout = SimpleNamespace(names=names, unit=LAYOUT.unit)
    return SimpleNamespace(
        layout=layout, **dict(zip(("estimate", "std", "identifiable"), columns, strict=True))
    )


def test_variation_is_the_standard_deviation_over_the_mean_and_its_table_stands_beside_the_papers():
    found = variation(
        [
            result([9.0, 1.0, 0.0], [0.3, 0.1, 1.0], [True, True, False]),
            result([10.0, 1.1, 0.0], [0.4, 0.1, 1.0], [True, True, True]),
            result([11.0, 1.2, 0.0], [0.5, 0.1, 1.0], [True, True, True]),
        ]
    )
    assert found.variation[:2] == pytest.approx([0.1, 0.1 / 1.1])
    assert found.expected[0] == pytest.approx(np.sqrt((0.09 + 0.16 + 0.25) / 3) / 10)
    assert np.isnan(found.variation[2]), "a mean of zero has no relative variation"
    assert list(found.identified) == [True, True, False], "in every run, not in some"
    assert found.worst == ("link1.mass", pytest.approx(0.1))
    assert repr(found) == "<Variation: 2 of 3 parameters identified in all 3 runs>"
    assert found.to_dataframe().loc["link1.mass", "variation"] == pytest.approx(0.1)
    table = variation_table(found)
    assert [row[0] for row in table.rows] == ["link1.mass", "joint1.coulomb"]
    assert table.rows[1][3:] == ("9.091", "9.091", "15.9")
    assert max(PAPER_PERCENT.values()) == PAPER_WORST_PERCENT
    nothing = [result([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [False] * 3)] * 3
    with pytest.raises(EstimationError, match="no parameter is identified in each of the 3 runs"):
        _ = variation(nothing).worst


@pytest.mark.thorough
def test_the_command_identifies_each_unseen_run(tmp_path, capsys):
    """Estimates vary as their intervals say: the mean square of variation over expectation is near
    one.
    """
    (tmp_path / "scenario.toml").write_text(quick().to_toml(), encoding="utf-8")
    runs = [(run_plant(quick(), seed, trajectory_seed=seed)[0], None) for seed in range(3)]
    write_runs(tmp_path / "validation.nc", runs)
    assert command("variation", "--out", tmp_path) == 0
    assert "largest:" in capsys.readouterr().out
    entry = json.loads((tmp_path / "variation.json").read_text(encoding="utf-8"))
    assert (entry["runs"], entry["trajectories"]) == (3, "unseen")
    judged = {
        n: p
        for n, p in entry["parameters"].items()
        if p["identified_in_every_run"] and n != "platform.mass"
    }
    assert len(judged) > 15
    assert entry["worst"]["variation_percent"] == max(
        p["variation_percent"] for p in judged.values()
    )
    ratios = [p["variation_percent"] / p["expected_percent"] for p in judged.values()]
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.7, ratios
    assert "| joint1.coulomb |" in (tmp_path / "variation.md").read_text(encoding="utf-8")
    assert (tmp_path / "figures" / "variation.png").read_bytes()[:4] == b"\x89PNG"


def test_a_folder_without_runs_or_with_too_few_is_refused(tmp_path, capsys):
    (tmp_path / "scenario.toml").write_text(quick().to_toml(), encoding="utf-8")
    assert command("variation", "--out", tmp_path) == 1
    assert "cmmsim validate" in one_line(capsys.readouterr().err)
    write_runs(tmp_path / "validation.nc", 2 * [(short_run()[0], None)])
    assert command("variation", "--out", tmp_path) == 1
    assert "2 runs show no variation" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "variation.json").exists()


def designed(folder, count, scenario, *settings, workers=2):
    """Entry of `variation.json` of runs with images, each on an exciting trajectory of its own."""
    words = [word for setting in settings for word in ("--set", setting)]
    assert (
        command(
            "excite", scenario, "--out", folder, "--quiet", "--set", "renderer=analytic", *words
        )
        == 0
    )
    assert (
        command("variation", "--out", folder, "--designed", count, "--workers", workers, "--quiet")
        == 0
    )
    records = recording.read_runs(folder / "variation.nc")
    paths = [recording.poses(record, "reference") for record in records]
    assert len(paths) == count
    assert not any(np.allclose(a, b) for a, b in combinations(paths, 2))
    return json.loads((folder / "variation.json").read_text(encoding="utf-8"))


@pytest.mark.thorough
def test_runs_are_designed_and_recorded_one_by_one_where_asked(tmp_path):
    entry = designed(
        tmp_path / "run",
        3,
        "quick",
        "excitation.candidates=2",
        "excitation.duration_s=6",
        workers=1,
    )
    assert (entry["runs"], entry["trajectories"]) == (3, "designed: random")
    assert entry["worst"]["variation_percent"] > 0


@pytest.mark.thorough
def test_every_identified_parameter_varies_by_5_percent_at_most(tmp_path):
    """Runs of 20 s with images, each on a fast trajectory of its own, the best of three climbs; the
    goal for table 5.

    Their own intervals let expect no more, and they vary no more than these say, but for one chance
    in a thousand.
    """
    runs = 10
    entry = designed(tmp_path / "run", runs, "paper", "excitation.fundamental_hz=0.3")
    assert (entry["runs"], entry["trajectories"]) == (runs, "designed: gradient")
    found = {
        name: seen for name, seen in entry["parameters"].items() if seen["identified_in_every_run"]
    }
    assert set(found) == IDENTIFIED
    chance = np.sqrt(chi2.ppf(1 - 1e-3 / len(found), runs - 1) / (runs - 1))
    for name, seen in found.items():
        assert max(seen["expected_percent"], seen["variation_percent"]) <= 5.0, (name, seen)
        assert seen["variation_percent"] <= chance * seen["expected_percent"], (name, seen)
