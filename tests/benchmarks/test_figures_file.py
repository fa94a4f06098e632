"""The file of quoted figures is written when all of them were measured, and stays as it was otherwise."""

import json
from types import SimpleNamespace

import pytest

from tests.benchmarks import conftest


@pytest.fixture
def finish(tmp_path):
    """(figures, failed) -> what the file holds after a session that found these, and what was said."""

    def end(found, failed=0):
        path, said = tmp_path / "figures.json", []
        path.write_text("{}")
        skipped = SimpleNamespace(longrepr=("file", 1, "Skipped: others took a core"))
        reporter = SimpleNamespace(write_line=said.append, stats={"skipped": [skipped]})
        config = SimpleNamespace(
            getoption=lambda *_, **__: path, stash={conftest.measured: found},
            pluginmanager=SimpleNamespace(get_plugin=lambda _: reporter),
        )
        conftest.pytest_sessionfinish(SimpleNamespace(config=config, testsfailed=failed))
        return json.loads(path.read_text()), said[0]

    return end


def test_all_figures_are_written_with_versions_and_cores(finish):
    found = {name: float(index) for index, name in enumerate(conftest.FIGURES)}
    entry, said = finish(found)
    assert entry["figures"] == found
    assert set(entry["versions"]) == {"python", *conftest.PACKAGES}
    assert entry["cores"] >= 1
    assert "written" in said


@pytest.mark.parametrize(("left_out", "failed"), [("times_real_time", 0), (None, 1)])
def test_file_stays_where_a_figure_is_missing_or_a_goal_was_missed(finish, left_out, failed):
    entry, said = finish({name: 1.0 for name in conftest.FIGURES if name != left_out}, failed)
    assert entry == {}
    assert f"{failed} tests failed" in said
    assert "others took a core" in said
    assert (left_out or "not measured") in said
