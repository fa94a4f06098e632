"""The file of quoted figures is written when all of them were measured, and stays as it was otherwise."""

import json
from types import SimpleNamespace

import pytest

from tests.benchmarks import conftest


@pytest.fixture(params=conftest.QUOTED)
def quoted(request):
    """A name of quoted figures, and what it quotes."""
    return request.param, conftest.QUOTED[request.param]


@pytest.fixture
def finish(quoted, tmp_path):
    """(figures, failed) -> what the file holds after a session that found these, and what was said."""

    def end(found, failed=0):
        path, said = tmp_path / "figures.json", []
        path.write_text("{}")
        skipped = SimpleNamespace(longrepr=("file", 1, "Skipped: others took a core"))
        reporter = SimpleNamespace(write_line=said.append, stats={"skipped": [skipped]})
        config = SimpleNamespace(
            getoption=lambda option, **_: path if option == f"--{quoted[0]}-figures" else None,
            stash={conftest.measured: found},
            pluginmanager=SimpleNamespace(get_plugin=lambda _: reporter),
        )
        conftest.pytest_sessionfinish(SimpleNamespace(config=config, testsfailed=failed))
        return json.loads(path.read_text()), *said

    return end


def test_all_figures_are_written_with_versions_and_cores(quoted, finish):
    found = {name: float(index) for index, name in enumerate(quoted[1].figures)}
    entry, said = finish({**found, "of_another_file": 1.0})
    assert entry["figures"] == found
    assert set(entry["versions"]) == {"python", *quoted[1].packages}
    assert entry["cores"] >= 1
    assert "is written" in said


@pytest.mark.parametrize(("left_out", "failed"), [(0, 0), (None, 1)])
def test_file_stays_where_a_figure_is_missing_or_a_goal_was_missed(quoted, finish, left_out, failed):
    names = quoted[1].figures
    entry, said = finish({name: 1.0 for index, name in enumerate(names) if index != left_out}, failed)
    assert entry == {}
    assert f"{failed} tests failed" in said
    assert "others took a core" in said
    assert ("not measured" if left_out is None else f"not measured: {names[left_out]}") in said
