"""Starting files: each is read by its command and works as it is; and schemas for editors are those
of the readers.
"""

import json
import re
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from cmmsim.files import read_sensor_file
from cmmsim.files.sensor_file import built_in_names, sensor_schema
from dynamics import built_in_robots, load_robot
from dynamics.robot_file import robot_schema
from identify.commands.help import DONE, NOT_DONE
from identify.record.columns import CommandColumns, PoseColumns
from identify.record.own_record import record_schema
from identify.scenario import load_scenario, scenario_names
from identify.scenario.scenario import scenario_schema
from identify.schemas import ROOT, SCHEMAS
from identify.studies.study_design import prepare
from identify.studies.study_file import STARTING, STUDIES, load_study, study_schema
from tests.identify.commands import command, one_line


def some(names, *quick):
    """All names, most of them among the slow ones."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def write(*words):
    assert command("new", *words) == DONE


def schema_named_in(path):
    """The schema that the first line of a file names."""
    first = Path(path).read_text().splitlines()[0]
    assert first.startswith("#:schema file:///")
    return json.loads(Path(urlsplit(first.removeprefix("#:schema ")).path).read_text())


@pytest.mark.parametrize("name", some(built_in_robots(), "ups6"))
def test_a_new_robot_is_the_built_in_one_under_the_name_of_its_file(name, capsys):
    write("robot", "mine.toml", "--like", name)
    assert "cmmsim check mine.toml" in capsys.readouterr().out
    mine, theirs = load_robot("mine.toml"), load_robot(name)
    assert mine.name == "mine"
    assert (mine.nominal_parameters == theirs.nominal_parameters).all()
    assert schema_named_in("mine.toml") == robot_schema()


@pytest.mark.slow
def test_a_new_robot_of_other_lengths_is_written_and_a_length_it_does_not_have_is_refused(capfd):
    lengths = ("--base-radius", 0.4, "--platform-radius", 0.1, "--crank", 0.2, "--link", 0.3)
    write("robot", "mine.toml", "--like", "rrr3", *lengths)
    mine = load_robot("mine.toml")
    assert (mine.name, mine.geometry.legs[0].crank_length) == ("mine", 0.2)
    text = Path("mine.toml").read_text()
    assert "# from B to the crank's tip, m\ncrank_length = 0.2" in text
    assert "base_radius 0.4 m, platform_radius 0.1 m, crank 0.2 m, link 0.3 m" in " ".join(
        text.replace("#", "").split()
    )
    assert schema_named_in("mine.toml") == robot_schema()
    assert command("new", "robot", "other.toml", "--like", "rrr3", "--leg", 0.3) == NOT_DONE
    assert "rrr3 has no length --leg; valid: --base-radius, --platform-radius" in one_line(
        capfd.readouterr().err
    )
    assert not Path("other.toml").exists()
    mm = ("--base-radius", 250, "--platform-radius", 150, "--crank", 80, "--link", 250)
    for lengths, said in ((mm, "link 250 m"), (mm[:2], "base-radius 250 m")):
        assert command("new", "robot", "other.toml", *lengths) == NOT_DONE
        says = one_line(capfd.readouterr().err)
        assert "cannot write other.toml: lengths are in m: base-radius 250 m" in says
        assert said in says
        assert len(says) < 160


@pytest.mark.parametrize("name", built_in_names())
def test_a_new_sensor_is_the_built_in_one(name):
    write("sensor", "mine.toml", "--like", name, "--quiet")
    assert read_sensor_file("mine.toml") == read_sensor_file(name).model_copy(
        update={"name": "mine"}
    )
    assert schema_named_in("mine.toml") == sensor_schema()


@pytest.mark.parametrize("name", scenario_names())
def test_a_new_scenario_has_every_key_and_is_the_built_in_one_until_a_comment_is_taken_away(name):
    write("scenario", "mine.toml", "--like", name, "--quiet")
    mine, theirs = load_scenario("mine.toml"), load_scenario(name)
    assert mine.model_dump(exclude={"name"}) == theirs.model_dump(exclude={"name"})
    text = Path("mine.toml").read_text()
    for section, model in mine:
        for key in getattr(type(model), "model_fields", {}):
            assert re.search(rf"^\[{section}\](?:\n.+)*\n(# )?{key} =", text, re.MULTILINE), (
                f"{section}.{key}"
            )
    text = re.sub(r"^# (latency_s =) 0.0", r"\1 0.01", text, flags=re.MULTILINE)
    Path("mine.toml").write_text(text)
    assert load_scenario("mine.toml").timing.latency_s == 0.01
    assert schema_named_in("mine.toml") == scenario_schema()


@pytest.mark.parametrize("name", some([None, *STUDIES.names()], None, "frame_rate"))
def test_a_new_study_can_be_run(name):
    write("study", "mine.toml", "--quiet", *([] if name is None else ["--like", name]))
    study = load_study("mine.toml")
    assert study.name == "mine"
    prepare(study)
    if name is not None:
        assert study == load_study(name).model_copy(update={"name": "mine"})
    assert schema_named_in("mine.toml") == study_schema()


@pytest.mark.slow
def test_the_starting_study_runs_and_draws_what_it_chooses(capsys):
    write("study", "mine.toml")
    assert (
        command(
            "study", "mine.toml", "--set", "repeats=2", "--workers", 0, "--quiet", "--json", "-"
        )
        == DONE
    )
    assert (
        json.loads(capsys.readouterr().out.partition("\n{")[2].join(["{", ""]))["rows"]["done"] == 6
    )
    drawn = {path.name for path in Path("runs/study-mine/figures").iterdir()}
    assert drawn == {f"by_sensor.camera.dark_noise.{kind}" for kind in ("png", "pdf", "svg")}


@pytest.mark.parametrize("name", some(["rss6", "ups6", "delta3"], "ups6"))
def test_a_new_record_is_read_and_asks_for_its_rows(name, capfd):
    write("record", "mine.csv", name)
    assert command("identify", "--record", "mine.csv", "--out", "never", "--quiet") == NOT_DONE
    assert "the record has 2 frames" in one_line(capfd.readouterr().err)
    assert schema_named_in("mine.toml") == record_schema()
    columns = Path("mine.toml").read_text().partition("# [columns.measured]")[2]
    for key in {**PoseColumns.model_fields, **CommandColumns.model_fields}:
        assert f"# {key} =" in columns
    assert '# convention = "?"' in columns
    assert "a model can close its own loop" in " ".join(
        Path("mine.csv").read_text().replace("#", "").split()
    )


def test_nothing_is_replaced_and_what_cannot_be_written_leaves_nothing(capfd):
    Path("there.toml").write_text("mine")
    Path("lab.csv").write_text("mine")
    for words, says in (
        (("robot", "there.toml"), "there.toml exists already and is not replaced"),
        (("record", "there.csv"), "there.toml exists already and is not replaced"),
        (("study", "a.txt"), "its name must end in .toml"),
        (("scenario", "a b.toml"), "and consist of letters, digits, dots, _ and -"),
        (
            ("sensor", "a.toml", "--like", "eye"),
            "unknown sensor 'eye' after --like; valid: ctrack780, ctrack780_29hz",
        ),
        (("record", "a.toml"), "must end in .csv"),
        (("record", "lab.csv", "ups6"), "cmmsim new record lab.csv ups6 --from lab.csv"),
        (("record", "a.csv", "none"), "unknown robot `none`"),
    ):
        assert command("new", *words) == NOT_DONE
        assert says in one_line(capfd.readouterr().err)
    assert Path("there.toml").read_text() == "mine"
    assert {path.name for path in Path().iterdir()} == {"there.toml", "lab.csv"}


@pytest.mark.parametrize("kept", SCHEMAS, ids=lambda path: path.stem)
def test_a_schema_for_editors_is_that_of_the_files_that_are_read(kept):
    wanted = SCHEMAS[kept]()
    assert json.loads(kept.read_text(encoding="utf-8")) == wanted, (
        "renew it: python -m identify.schemas"
    )


def files():
    for kind, folder in (("robot", "dynamics/robots"), ("sensor", "cmmsim/files/sensors")):
        yield from ((kind, path) for path in sorted((ROOT / folder).glob("*.toml")))
    yield from (
        ("scenario", path) for path in sorted((ROOT / "identify/scenario/built_in").glob("*.toml"))
    )
    yield from (
        ("study", path) for path in sorted((ROOT / "identify/studies/built_in").glob("*.toml"))
    )
    yield "study", STARTING


@pytest.mark.parametrize(
    ("kind", "path"), list(files()), ids=lambda value: getattr(value, "stem", value)
)
def test_an_editor_finds_no_fault_in_a_built_in_file_and_a_fault_in_a_spoilt_one(kind, path):
    """Against the public validator of JSON schemas."""
    validator = pytest.importorskip("jsonschema").Draft202012Validator
    schema = next(make() for kept, make in SCHEMAS.items() if kept.name == f"{kind}.schema.json")
    content = tomllib.loads(path.read_text())
    assert [error.message for error in validator(schema).iter_errors(content)] == []
    assert list(validator(schema).iter_errors(content | {"unknown": 1}))
    assert list(
        validator(schema).iter_errors(
            {key: value for key, value in content.items() if key != "name"}
        )
    )
