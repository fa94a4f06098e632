"""Files within limits: what is large, deep or endless is refused in one line, and soon."""

import time
from collections.abc import Callable

import numpy as np
import pytest

import cmmsim.checks
from cmmsim.errors import SensorFileError
from dynamics import DynamicsError, load_robot
from dynamics.engines.mechanism import Connection, Freedom, Mechanism, Solid, legs_of
from dynamics.engines.urdf_import import robot_of_urdf
from dynamics.errors import RobotFileError
from dynamics.files import (
    DEEPEST,
    LARGEST,
    LONGEST_NAME,
    NAME,
    check_name,
    parse_toml,
    parse_xml,
    parse_yaml,
    read_bytes,
)


def refused(action: Callable[..., object], *arguments: object) -> str:
    """The one line with which an action refuses, in a tenth of the time that a file may take."""
    began = time.process_time()
    with pytest.raises((DynamicsError, cmmsim.CmmError)) as caught:
        action(*arguments)
    assert time.process_time() - began < 5
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
    return str(caught.value)


TOML = {
    "a" + ".a" * 200_000 + " = 1": "deep",
    "x = " + "[" * 400_000: "deep",
    "x = " + "{a = " * 5000: "deep",
    "x = " + "[" * (DEEPEST + 1) + "]" * (DEEPEST + 1): "deep",
    "x = " + "9" * 5000: "integer beyond 64 bits",
    "x = 9223372036854775808": "integer beyond 64 bits",
    'x = "a\\u0000b"': "control character in 'a\\x00b'",
    '"a\\u001b" = 1': "control character",
    'x = """' + '\\"""' * 100_000: "TOML",
    "'" * 400_000: "TOML",
    '"\\' * 200_000: "TOML",
}


@pytest.mark.parametrize("text", TOML, ids=lambda text: repr(text[:12]))
def test_toml_that_is_deep_or_endless_is_refused_by_both_readers(text):
    assert TOML[text] in refused(parse_toml, text, "file x", RobotFileError)
    assert TOML[text] in refused(cmmsim.checks.parsed, text, "file x", SensorFileError)


def test_dots_and_brackets_in_texts_comments_and_numbers_are_no_depth():
    deep = ".".join("abcdefghijklmnopqrstuvwxyz")
    text = f"# {deep}\nx = '{deep}'  # {deep}\ny = [{'0.5, ' * 100}]\nz = '''\n{deep}'''\n"
    found = parse_toml(text, "file x", RobotFileError)
    assert found == cmmsim.checks.parsed(text, "file x", SensorFileError)
    assert found == {"x": deep, "y": [0.5] * 100, "z": deep}


def test_a_file_that_is_large_endless_or_none_is_refused(tmp_path):
    path = tmp_path / "x.toml"
    path.write_bytes(b"#" * (LARGEST + 1))
    assert "500,000 bytes" in refused(read_bytes, path, "file x", RobotFileError)
    assert "500,000 bytes" in refused(cmmsim.checks.read_text, path, "file x", SensorFileError)
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "not a regular file" in refused(read_bytes, path, "file x", RobotFileError)
    assert "not a regular file" in refused(cmmsim.checks.read_text, path, "file x", SensorFileError)
    assert "unknown robot" in refused(load_robot, "a\0b")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: &a [x]\nb: [*a, *a]", "alias, *a"),
        ("[" * 90_000, "deep"),
        ("a: [x]\na: [y]", "file x line 2 has the key 'a' twice"),
        ("a:\n- b: x\n  c: y\n  b: z", "file x line 4 has the key 'b' twice"),
        ("a: [x", "cannot read"),
    ],
)
def test_yaml_with_aliases_depth_or_a_key_twice_is_refused(text, said):
    assert said in refused(parse_yaml, text.encode(), "file x", RobotFileError)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('<!DOCTYPE a [<!ENTITY x "xx">]><a>&x;</a>', "document type"),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "document type"),
        ("<a>" * 200_000, "deep"),
        ("<a", "cannot read"),
    ],
)
def test_xml_with_entities_or_depth_is_refused(text, said):
    assert said in refused(parse_xml, text.encode(), "file x", RobotFileError)


@pytest.mark.parametrize(
    "name", ["../../x", "/abs/x", "a/b", "..", ".x", "-x", "", "a\0b", "a\n", "x" * 61, "c:\\x"]
)
def test_what_could_be_a_path_is_no_name_in_any_package(name):
    for check in (check_name, cmmsim.checks.check_name):
        with pytest.raises(ValueError, match=f"at most {LONGEST_NAME} letters"):
            check(name)
        assert check("Röhre 2.1_b+c-d") == "Röhre 2.1_b+c-d"
    assert (NAME, LONGEST_NAME) == (cmmsim.checks.NAME, cmmsim.checks.LONGEST_NAME)


CLOSURES = "closed_loop: []\nname_mot: []\n"


def test_a_urdf_of_thousands_of_links_or_of_a_name_twice_is_refused_at_once(tmp_path):
    path, beside = tmp_path / "x.urdf", tmp_path / "x.yaml"
    beside.write_text(CLOSURES)
    ends = '<parent link="l{0}"/><child link="l{1}"/>'
    links = [f'<link name="l{k}"/>' for k in range(3001)]
    joints = [
        f'<joint name="j{k}" type="revolute">{ends.format(k, k + 1)}</joint>' for k in range(3000)
    ]
    path.write_text(f"<robot>{''.join(links + joints)}</robot>")
    assert "3001 elements link, a robot has at most 120" in refused(robot_of_urdf, path, beside)
    path.write_text(f"<robot>{''.join(links[:101] + joints[:100])}</robot>")
    assert "100 coordinates, a robot has at most 90" in refused(robot_of_urdf, path, beside)
    path.write_text(f"<robot>{''.join(links[:2] + links[:1] + joints[:1])}</robot>")
    assert "the name of a link has 'l0' more than once" in refused(robot_of_urdf, path, beside)


def test_a_leg_with_ways_without_number_is_refused():
    """Every body is joined to every other, which makes more ways than can be counted."""
    count = 26
    solids = [Solid(f"body {k}", 1.0, np.zeros(3), np.eye(3), np.eye(3)) for k in range(count)]
    hinge = (Freedom("hinge", "joint", np.zeros(3), np.array([0.0, 0.0, 1.0])),)
    joined = [Connection(a, b, hinge) for b in range(count) for a in range(b) if (a, b) != (0, 1)]
    mechanism = Mechanism("tangle", solids, joined, np.zeros(3))
    ways = legs_of(mechanism, 1, np.eye(3, 4))
    refusal = refused(list, ways)
    assert "joints and 24 bodies" in refusal
    assert "would have at most 26 joints" in refusal
