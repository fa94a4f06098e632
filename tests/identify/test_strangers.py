"""Files from strangers, changed at random, are read as they say or refused in one line.

The oracle is the file itself: its numbers, as `tomllib`, `csv` and `json` find them here, must be
those of what was loaded. A seed decides all changes.
"""

import csv
import json
import random
import re
import resource
import signal
import tomllib
from collections.abc import Mapping

import numpy as np
import pytest

import cmmsim
from cmmsim.calibration.board import read_board
from cmmsim.files.rig_and_bodies import rig_from_file
from cmmsim.files.sensor_file import built_in_names, read_sensor_file, sensor_text
from cmmsim.geometry.stereo_rig import PARAMETER_NAMES
from dynamics import DynamicsError, built_in_robots, load_robot
from dynamics.engines.mjcf import mjcf_text
from dynamics.engines.mjcf_import import robot_of_mjcf
from dynamics.engines.urdf import urdf_texts
from dynamics.engines.urdf_import import robot_of_urdf
from dynamics.files import LONGEST_NAME, is_name
from dynamics.robot_file import read_robot_file
from identify.commands.options import built_in_folder
from identify.errors import IdentifyError
from identify.experiment.rig_as_known import stated_covariance
from identify.loop_parameters import choose_parameters
from identify.record.csv_record import columns_of
from identify.record.own_record import read_own_records
from identify.record.readers.csv_exports import LoggedTable
from identify.record.record_template import description_text, table_text
from identify.scenario import load_scenario, scenario_names
from identify.scenario.scenario import SCENARIOS
from identify.studies.study_design import prepare
from identify.studies.study_file import STARTING, STUDIES, load_study
from tests.identify.commands import command, one_line, refusal
from tests.identify.study_rows import PATIENCE, process

KNOWN = (DynamicsError, IdentifyError, cmmsim.CmmError)
SECONDS = 10
BYTES = 10**9

NUMBER = re.compile(r"(?<![\w.])[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")
WORD = re.compile(r'(?<=")[^"\n]+(?=")')
VALUES = [
    "0",
    "-1",
    "-0.0",
    "1e18",
    "1e-300",
    "1e25",
    "1e308",
    "1e400",
    "9223372036854775807",
    "9223372036854775808",
    "inf",
    "-inf",
    "nan",
    "true",
    "[]",
    "{}",
    "[1,2]",
    "[[1]]",
    "0x10",
    "1_000",
    "1979-05-27",
    "1979-05-27T07:32:00Z",
    "12:00:00",
    "0.5",
    "2",
    "3.0",
]
VALUES += ["7" * 5000, '"1.5"', '"../../x"', '"/abs/x"', '"a\\u0000b"', '"os:abort"', '"\\u001b"']
NAMES = [
    "../../x",
    "/abs/x",
    "a\\u0000b",
    "os:abort",
    "x" * 300,
    "é漢字",
    "..",
    " ",
    "con\\n",
    "{}",
]
LETTERS = "\0\x1b\ufeff\u202e\"'[]{}=.,#<>&-_5 e\n\r\t"


def changed(text, rng):
    """The text with one to three changes of random kinds."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        text = rng.choice(CHANGES)(text, rng)
    return text


def one_of(pattern, text, rng, new):
    """The text with one place of a pattern changed."""
    found = list(pattern.finditer(text))
    if not found:
        return text
    at = rng.choice(found)
    return text[: at.start()] + new(at.group()) + text[at.end() :]


def other_number(text, rng):
    return one_of(NUMBER, text, rng, lambda _: rng.choice(VALUES))


def scaled_number(text, rng):
    power = rng.choice((-300, -30, -12, -3, -1, 1, 3, 12, 30))
    return one_of(NUMBER, text, rng, lambda old: "1" if "e" in old else f"{float(old)}e{power}")


def other_name(text, rng):
    return one_of(WORD, text, rng, lambda _: rng.choice(NAMES))


def nested(text, rng):
    count = rng.choice((3, 20, 300, 5000))
    return one_of(NUMBER, text, rng, lambda old: "[" * count + old + "]" * count)


def cut(text, rng):
    return text[: rng.randrange(len(text) + 1)]


def other_letter(text, rng):
    at = rng.randrange(len(text) + 1)
    return text[:at] + rng.choice(LETTERS) + text[at + rng.choice((0, 1)) :]


def with_line(text, rng, line):
    lines = text.split("\n")
    lines.insert(rng.randrange(len(lines)), line)
    return "\n".join(lines)


def without_line(text, rng):
    lines = text.split("\n")
    lines.pop(rng.randrange(len(lines)))
    return "\n".join(lines)


def line_twice(text, rng):
    return with_line(text, rng, rng.choice(text.split("\n")))


def deep_key(text, rng):
    return with_line(text, rng, ".".join("a" * rng.choice((3, 30, 3000, 100_000))) + " = 1")


def long(text, rng):
    line = rng.choice(("[[legs]]", "# x", "x = 1", f"y = [{'0,' * 10}]", '"a" = "b"'))
    return with_line(text, rng, (line + "\n") * rng.choice((10, 1000, 50_000)))


CHANGES = [other_number] * 3 + [scaled_number] * 2 + [other_letter] * 2
CHANGES += [other_name, nested, cut, without_line, line_twice, deep_key, long]


class TooLong(BaseException):
    """Raised within what takes more than its time."""


def accepted(read, *arguments):
    """Whether a file is read; one that is not must be refused in one line, and either soon."""

    def late(*_):
        raise TooLong

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    said = None
    try:
        read(*arguments)
    except KNOWN as error:
        said = str(error)
    finally:
        signal.alarm(0)
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        assert grown < BYTES
    if said is not None:
        assert len(said.splitlines()) == 1, said[:500]
        assert len(said) < 5000
    return said is None


def same(stated, loaded):
    """Whether a stated value is the loaded one; a number may be spelt as an integer."""
    if isinstance(stated, bool) or isinstance(loaded, bool):
        return isinstance(stated, bool) and isinstance(loaded, bool) and stated == loaded
    if isinstance(stated, (int, float)):
        return isinstance(loaded, (int, float)) and stated == loaded
    if isinstance(stated, Mapping):
        return all(key in loaded and same(value, loaded[key]) for key, value in stated.items())
    if isinstance(stated, list):
        loaded = loaded.tolist() if isinstance(loaded, np.ndarray) else loaded
        return len(stated) == len(loaded) and all(map(same, stated, loaded))
    return stated == loaded


def test_a_value_that_was_lost_turned_or_made_of_another_kind_is_seen():
    stated = {"a": 1, "b": [0.5, True], "c": {"d": "x"}}
    loaded = {"a": 1.0, "b": (0.5, True), "c": {"d": "x", "e": 2}}
    assert same(stated, loaded)
    for other in ({"a": 1.0 + 1e-15}, {"a": True}, {"a": "1"}, {"b": [0.5]}, {"b": [0.5, 1]}):
        assert not same(stated, loaded | other), other
    assert not same(stated, {"a": 1.0, "b": (0.5, True)})


def stated_in(path):
    return tomllib.loads(path.read_text(encoding="utf-8"))


def read_robot(path):
    found = read_robot_file(path)
    stated = stated_in(path)
    assert found.name == stated["name"]
    assert same(stated["travel_limit"], found.geometry.travel_limit)
    assert same(stated["home_pose"], found.geometry.home_pose)
    if "gravity" in stated:
        assert same(stated["gravity"], found.geometry.gravity)
    for number, leg in enumerate(found.geometry.legs):
        check_leg(stated["legs"], number, leg)
    layout = load_robot(path).layout
    for name, tables in stated["parameters"].items():
        values = dict(zip(layout.names, found.parameter_sets[name].vector.tolist(), strict=True))
        for kind, table in tables.items():
            for key, value in table.items():
                if key != "unit":
                    check_parameter(values, kind, key, value)


def check_leg(legs, number, leg):
    """The numbers of a leg are those of its table, or of the columns for all legs."""
    fields = type(leg).model_fields
    if isinstance(legs, list):
        stated = legs[number]
    else:
        stated = {}
        for key, value in legs.items():
            singular = re.sub("axes$", "axis", key)
            name = next(n for n in (key, singular, key.removesuffix("s")) if n in fields)
            vector = isinstance(getattr(leg, name), np.ndarray)
            each = isinstance(value, list) and (not vector or isinstance(value[0], list))
            stated[name] = value[number] if each else value
    for name, value in stated.items():
        loaded = getattr(leg, name)
        if isinstance(loaded, np.ndarray):  # directions are set right to their last digits
            np.testing.assert_allclose(loaded, value, rtol=0, atol=2e-4)
        else:
            assert same(value, loaded)


def check_parameter(values, kind, key, value):
    names = [name for name in values if re.fullmatch(rf"{kind}\d*\.{key}", name)]
    assert names
    for number, name in enumerate(names):
        assert same(value[number] if isinstance(value, list) else value, values[name])


def read_scenario(path):
    found = load_scenario(path)
    stated = stated_in(path)
    loaded = found.model_dump()
    for table in (stated, loaded):
        for key in ("robot", "sensor", "sensor_changes"):
            table.pop(key, None)
        for section in ("rig", "geometry"):
            table.get(section, {}).pop("known", None)
    assert same(stated, loaded)


def read_sensor(path):
    found = read_sensor_file(path)
    stated = stated_in(path)
    if "distance" in stated.get("rig", {}):
        stated["rig"].pop("position", None)
    if "per_plane" in stated.get("stickers", {}):
        for plane in stated.get("platform", {}).get("planes", {}).values():
            plane.pop("stickers")
    assert same(stated, found.model_dump())
    cmmsim.load_sensor(path, renderer=None if ":" in found.renderer else "analytic")


def read_study(path):
    found = load_study(path)
    prepare(found)
    stated = stated_in(path)
    loaded = found.model_dump()
    for name in ("name", "title", "kind", "sample", "repeats", "seed", "options", "figures"):
        assert name not in stated or same(stated[name], loaded[name]), name
    for name in ("changes", "factors"):
        for key, value in by_path(stated.get(name, {})):
            assert key.endswith((".robot", ".sensor", ".known")) or same(value, loaded[name][key])
    for law, known in zip(stated.get("theory", []), loaded["theory"], strict=True):
        assert same(law, known)


def by_path(tables, section=""):
    for key, value in tables.items():
        if isinstance(value, dict) and value and not {"low", "high"} & set(value):
            yield from by_path(value, f"{section}{key}.")
        else:
            yield f"{section}{key}", value


def read_record(path):
    (found,), _ = read_own_records([path.with_suffix(".csv")])
    lines = path.with_suffix(".csv").read_text(encoding="utf-8-sig").splitlines()
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    header, *table = csv.reader(rows)
    places = {name.strip(): k for k, name in enumerate(header)}
    groups = columns_of(load_robot("rss6"))
    reference = np.hstack([found[f"reference_{of}"].values for of in ("position", "orientation")])
    for group, values in (("reference", reference), ("command", found["command"].values)):
        columns = [places[name] for name in groups[group].names]
        np.testing.assert_array_equal(
            values, [[float(row[k].strip()) for k in columns] for row in table]
        )


EXPORT = """Format Version,1.23,Rotation Type,Quaternion,Length Units,Meters

,,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body
,,Plate,Plate,Plate,Plate,Plate,Plate,Plate
,,1,1,1,1,1,1,1
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z
0,0.000000,0,0,0,1,0.001,0.002,0.2
1,0.016667,0,0,0.00100000,0.99999950,0.0011,0.002,0.201
2,0.033333,,,,,,,
3,0.050000,0,0,0,1,-0.5e-3,0.002,0.2
"""
TURNS = tuple(f"Plate Rotation {axis}" for axis in "XYZW")
PLACES = tuple(f"Plate Position {axis}" for axis in "XYZ")


def read_export(path):
    """In an export with its own header, the cells of a line are the numbers of a row."""
    found = LoggedTable(path).read("", ("Time (Seconds)", *TURNS, *PLACES))
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    numbers = np.stack([found.numbers(name) for name in (*TURNS, *PLACES)], axis=1)
    moments = found.moments("Time (Seconds)", "s", 60.0)
    if not set(EXPORT.splitlines()[2:7]) <= set(lines):
        return
    for row, number in enumerate(found.rows.numbers):
        cells = [cell.strip() for cell in next(csv.reader([lines[number - 1]]))]
        stated = [float(cell) if cell else np.nan for cell in cells[2:]]
        stated += [np.nan] * (len(numbers[row]) - len(stated))
        np.testing.assert_array_equal(numbers[row], stated)
        assert float(moments[row]) == float(cells[1])


def read_board_file(path):
    found = read_board(path)
    assert same(stated_in(path), found.model_dump())


def read_calibration(path):
    rig, _ = rig_from_file(read_sensor_file("ctrack780").rig)
    found = stated_covariance(path, rig)
    stated = json.loads(path.read_text(encoding="utf-8"))["covariance"]["matrix"]
    assert same(stated, found)


def read_result(path):
    robot = load_robot("rss6")
    found = choose_parameters(robot, str(path)).values
    stated = json.loads(path.read_text(encoding="utf-8"))["identification"]["parameters"]
    assert found.tolist() == [float(stated[n]["estimate"]) for n in robot.parameter_names]


def calibration_text():
    rig, _ = rig_from_file(read_sensor_file("ctrack780").rig)
    values = zip(PARAMETER_NAMES, rig.parameters, strict=True)
    content = {
        "image_size_px": [rig.left.width, rig.left.height],
        "parameters": {name: {"estimate": float(value)} for name, value in values},
        "covariance": {"names": list(PARAMETER_NAMES), "matrix": (1e-8 * np.eye(24)).tolist()},
    }
    return json.dumps(content, indent=1)


def result_text():
    robot = load_robot("rss6")
    values = zip(robot.parameter_names, robot.nominal_parameters.tolist(), strict=True)
    entries = {name: {"estimate": value} for name, value in values}
    return json.dumps({"identification": {"parameters": entries}}, indent=1)


def robot_texts():
    folder = built_in_folder("robot")
    return [(folder / f"{name}.toml").read_text("utf-8") for name in built_in_robots()]


def scenario_texts():
    built_in = [SCENARIOS.text(name)[0] for name in scenario_names()]
    return [*built_in, load_scenario("quick").to_toml()]


def study_texts():
    return [STARTING.read_text("utf-8"), *(STUDIES.text(name)[0] for name in STUDIES.names())]


def description_of_record():
    return description_text(load_robot("rss6"), "rss6", "x.csv")


def table_of_record():
    return table_text(load_robot("rss6"))


BOARD = 'kind = "dots"\ncolumns = 12\nrows = 9\nspacing = 0.03\nradius = 0.008\ndark = true\n'

KINDS = {
    "robot": (read_robot, robot_texts, "x.toml", 450),
    "scenario": (read_scenario, scenario_texts, "x.toml", 450),
    "sensor": (
        read_sensor, lambda: [sensor_text(name) for name in built_in_names()], "x.toml", 400
    ),
    "study": (read_study, study_texts, "x.toml", 300),
    "description": (read_record, lambda: [description_of_record()], "x.toml", 100),
    "table": (read_record, lambda: [table_of_record()], "x.csv", 100),
    "export": (read_export, lambda: [EXPORT], "x.csv", 100),
    "board": (read_board_file, lambda: [BOARD], "x.toml", 50),
    "calibration": (read_calibration, lambda: [calibration_text()], "x.json", 50),
    "result": (read_result, lambda: [result_text()], "x.json", 100),
}  # fmt: skip
"""How each kind of file is read and compared, the texts that are changed, and how many: 2,100."""


def check_changed(kind, part, tmp_path):
    """Read a share of the changed files of a kind. Returns how many were accepted."""
    read, texts, name, count = KINDS[kind]
    rng = random.Random(f"{kind} {part}")
    seeds = texts()
    path = tmp_path / name
    if read is read_record:
        (tmp_path / "x.csv").write_text(table_of_record(), encoding="utf-8")
        (tmp_path / "x.toml").write_text(description_of_record(), encoding="utf-8")
    taken = 0
    for number in range(round(part * count)):
        text = changed(rng.choice(seeds), rng)
        path.write_text(text, encoding="utf-8", newline="")
        try:
            taken += accepted(read, path)
        except (Exception, TooLong) as error:
            kept = path.with_name(f"{kind}_{number}{path.suffix}")
            kept.write_text(text, encoding="utf-8", newline="")
            raise AssertionError(f"{kept}: {type(error).__name__}: {str(error)[:500]}") from error
    return taken


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_tenth_of_the_changed_files_is_read_as_it_says_or_refused_in_a_line(kind, tmp_path):
    check_changed(kind, 0.1, tmp_path)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_two_thousand_changed_files_are_read_as_they_say_or_refused_in_a_line(kind, tmp_path):
    assert check_changed(kind, 1, tmp_path) > 0


def check_imports(count, tmp_path):
    """Read changed MJCF, URDF and YAML. Returns how many robots were found."""
    robot = load_robot("rss6")
    urdf, closures = urdf_texts(robot, allow_unphysical_inertia=True)
    texts = {
        "x.xml": mjcf_text(robot, allow_unphysical_inertia=True),
        "x.urdf": urdf,
        "x.yaml": closures,
    }
    rng = random.Random(f"imports {count}")
    taken = 0
    for number in range(count):
        name = tuple(texts)[number % 3]
        for beside, text in texts.items():
            (tmp_path / beside).write_text(text, encoding="utf-8")
        text = changed(texts[name], rng)
        (tmp_path / name).write_text(text, encoding="utf-8", newline="")
        try:
            if name == "x.xml":
                taken += accepted(robot_of_mjcf, tmp_path / name)
            else:
                taken += accepted(robot_of_urdf, tmp_path / "x.urdf", tmp_path / "x.yaml")
        except (Exception, TooLong) as error:
            kept = tmp_path / f"{number}_{name}"
            kept.write_text(text, encoding="utf-8", newline="")
            raise AssertionError(f"{kept}: {type(error).__name__}: {str(error)[:500]}") from error
    return taken


@pytest.mark.slow
def test_twenty_changed_mechanisms_of_other_programs_are_read_or_refused_in_a_line(tmp_path):
    pytest.importorskip("mujoco")
    check_imports(20, tmp_path)


@pytest.mark.thorough
def test_two_hundred_changed_mechanisms_are_read_or_refused_in_a_line(tmp_path):
    pytest.importorskip("mujoco")
    assert check_imports(200, tmp_path) > 0


# What a small file holds of which MuJoCo makes a huge model, and what is said of it.
HUGE_MODELS = {
    '<sensor><user dim="2000000000"/></sensor>': "Could not allocate memory",
    '<size nuser_body="2000000000"/>': "unknown exception",
    f"<worldbody>{'<site/>' * 142_000}</worldbody>": "cannot be read within 8 s",
}

IMPORT_AND_MEASURE = """
import resource
import sys
from tests.identify.commands import command
for path in sys.argv[1:]:
    print(command("import", "mjcf", path, "--out", "x.toml"))
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


@pytest.mark.thorough
def test_a_small_file_of_which_mujoco_makes_a_huge_model_is_one_line(tmp_path):
    pytest.importorskip("mujoco")
    for name, inside in enumerate(HUGE_MODELS):
        (tmp_path / f"{name}.xml").write_text(f"<mujoco>{inside}</mujoco>", encoding="utf-8")
    files = sorted(one.name for one in tmp_path.iterdir())
    (tmp_path / "measured.py").write_text(IMPORT_AND_MEASURE)
    # A process of its own, as the largest memory of children is over all that this one ever had.
    running = process("measured", *files, before=tmp_path)
    out, error = running.communicate(timeout=PATIENCE)
    *statuses, largest_kB = map(int, out.split())
    assert statuses == [1, 1, 1]
    for line, said in zip(error.splitlines(), HUGE_MODELS.values(), strict=True):
        assert said in one_line(line + "\n")
    assert not (tmp_path / "x.toml").exists()
    assert sorted(one.name for one in tmp_path.glob("*.*")) == [*files, "measured.py"]
    assert largest_kB < 1_500_000


def replaced(text, old, new, path):
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("read", "text", "old", "new", "said"),
    [
        (read_robot_file, robot_texts, "mass = 6.0", "mass = 1e-30", "1e-12 to 1e+06 kg"),
        (read_robot_file, robot_texts, "Izz = 0.11", "Izz = 1e25", "1e-24 to 1e+09 kg m^2"),
        (read_robot_file, robot_texts, "lp = 30.0", "lp = 1e18", "1e-09 to 1e+12"),
        (read_robot_file, robot_texts, "lp = 30.0", "lp = 1e-300", "0 or 1e-09"),
        (read_robot_file, robot_texts, "coulomb = 0.0", "coulomb = 1e25", "to 1e+09 N m or N"),
        (load_scenario, lambda: ['name = "x"\n[servo]\nkd = 1\n'], "1", "1e-300", "1e-09 to 1e+06"),
        (load_scenario, lambda: ['name = "x"\n[servo]\nkp = 1\n'], "1", "1e-300", "1e-16 to 1e+12"),
        (load_scenario, lambda: ['name = "x"\n[filter]\ncutoff_hz = 9\n'], "9", "1e25", "Hz"),
        (read_board, lambda: [BOARD], "0.03", "1e25", "less than or equal to 100"),
    ],
)
def test_numbers_that_no_machine_can_have_are_refused_with_the_range(
    read, text, old, new, said, tmp_path
):
    path = replaced(text()[0], old, new, tmp_path / "x.toml")
    assert said in refusal(KNOWN, read, path)


@pytest.mark.parametrize("name", ["../../x", "/abs/x", "a\\u0000b", "x" * (LONGEST_NAME + 1)])
def test_a_robot_whose_name_could_be_a_path_writes_nothing(name, tmp_path, monkeypatch, capsys):
    text = (built_in_folder("robot") / "rss6.toml").read_text("utf-8")
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    replaced(text, 'name = "rss6"', f'name = "{name}"', folder / "x.toml")
    monkeypatch.chdir(folder)
    for words in (("export", "mjcf"), ("workspace",)):
        assert command(*words, "x.toml", "--quiet") == 1
        one_line(capsys.readouterr().err)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["x.toml"]
    assert is_name("rss6")
