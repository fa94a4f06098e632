"""A TOML file of one kind where a command needs another kind."""

import pytest

from identify.commands.kinds_of_files import check_kind
from identify.commands.options import BUILT_IN, built_in_folder
from identify.errors import ScenarioError
from identify.scenario.scenario import scenario_from_toml
from tests.identify.commands import command, one_line

FILES = [(kind, path) for kind in BUILT_IN for path in sorted(built_in_folder(kind).glob("*.toml"))]


@pytest.mark.parametrize(("kind", "path"), FILES, ids=[path.stem for _, path in FILES])
def test_a_built_in_file_is_of_the_kind_of_its_folder_and_of_no_other(kind, path):
    check_kind(kind, str(path))
    for other in BUILT_IN.keys() - {kind}:
        with pytest.raises(ScenarioError, match=f"is a {kind} and not a {other}; it is used by"):
            check_kind(other, str(path))


def test_a_file_of_another_kind_is_refused_with_the_commands_that_use_it(tmp_path, capfd):
    robot = str(built_in_folder("robot") / "ups6.toml")
    sensor = str(built_in_folder("sensor") / "ctrack780.toml")
    take = tmp_path / "take.toml"
    take.write_text('robot = "rss6"\n[record]\nposition_std_m = 1e-5\n')
    for words, use in [
        (["run", robot], f"cmmsim run quick --robot {robot}"),
        (["run", "quick", "--robot", sensor], f"cmmsim run quick --set sensor={sensor}"),
        (["check", sensor], f"cmmsim acceptance {sensor}"),
        (["workspace", take], "cmmsim identify --record LOG"),
        # A description is checked as a record, but this one names no log.
        (["check", take], "a log beside its TOML file is given by its own name"),
        (["study", robot], f"cmmsim check {robot}"),
    ]:
        assert command(*words) == 1
        assert use in one_line(capfd.readouterr().err)


def test_valid_names_are_listed_once_for_several_wrong_ones():
    with pytest.raises(ScenarioError) as refused:
        scenario_from_toml('name = "a"\nlegs = 1\nfamily = 2\n[servo]\nlegs = 1\n')
    said = str(refused.value)
    assert said.count("unknown key") == 3
    assert said.count("valid names:") == 1
    assert said.count("valid names in [servo]:") == 1
