"""Columns of bodies and joints, by their names in the headers of logs."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from dynamics import Robot
from identify.record.readers.streams import Header, LoggedFile

# Units by their spellings at the end of a name, and in headers.
UNITS = {
    "mm": "mm",
    "millimeters": "mm",
    "cm": "cm",
    "centimeters": "cm",
    "um": "um",
    "m": "m",
    "meters": "m",
    "deg": "deg",
    "degrees": "deg",
    "rad": "rad",
    "radians": "rad",
    "turn": "turn",
    "turns": "turn",
    "s": "s",
    "sec": "s",
    "seconds": "s",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
}

# Words before x, y and z of a position.
PLACED = ("position", "pos", "translation", "pose", "p", "t")
# Words before x, y, z and w of a rotation.
TURNED = ("rotation", "orientation", "quaternion", "quat", "rot", "q")
# Names of three angles.
ANGLES = (("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("alpha", "beta", "gamma"))
# Words for desired poses.
WANTED = ("reference", "ref", "desired", "des", "target", "goal", "setpoint", "sp")
COMMANDED = ("command", "commands", "cmd", "commanded", *WANTED)  # words for commands of joints

# Words for what is neither a pose nor a command.
OTHERWISE = (
    *("velocity", "vel", "effort", "torque", "current", "rate", "acc", "covariance", "error"),
    "common",  # covariance of common errors, in tables of cmmsim measure
)


@dataclass(frozen=True)
class Place:
    """Part of a file that has columns. The topic is None if the file has no other part."""

    file: str
    topic: str | None
    header: Header
    log: LoggedFile
    part: str


@dataclass(frozen=True)
class Body:
    """Columns of a pose. The stem has the words that their names have in common."""

    place: Place
    stem: str
    position: tuple[str, ...]
    orientation: tuple[str, ...]
    convention: str | None
    """Convention of the orientation, or None if the names do not tell it."""

    @property
    def label(self) -> str:
        """Name by which a user chooses one of several bodies."""
        return " ".join(filter(None, (self.place.topic or "", self.stem))) or "the only one"


@dataclass(frozen=True)
class Joints:
    """Columns of commands. The stem is what their names have in common."""

    place: Place
    stem: str
    names: tuple[str, ...]

    @property
    def label(self) -> str:
        """Name by which a user chooses one of several groups of commands."""
        return " ".join(filter(None, (self.place.topic or "", self.stem))) or self.names[0]


def bodies_of(place: Place) -> Iterator[Body]:
    """Yield the poses whose columns a header names."""
    positions: dict[str, dict[str, str]] = {}
    turns: dict[str, dict[str, str]] = {}
    for name in place.header.names:
        words = _pose_words(name)
        if not words or has_word(name, OTHERWISE):
            continue
        last = words[-1].lower()
        before = words[:-1]
        kept = [word for word in before if word.lower() not in (*PLACED, *TURNED)]
        # Vicon names a subject and its segment, which are often alike.
        stem = " ".join(dict.fromkeys(kept))
        in_turn = last in ("w", "x", "y", "z") and has_word(" ".join(before), TURNED)
        if in_turn or re.fullmatch("q[wxyz]|rw", last):
            turns.setdefault(stem, {})[f"q{last[-1]}"] = name
        elif last in ("x", "y", "z"):
            positions.setdefault(stem, {})[last] = name
        elif re.fullmatch("(pos|p|t)[xyz]", last):
            positions.setdefault(stem, {})[last[-1]] = name
        elif any(last in angles for angles in ANGLES) or re.fullmatch("[rm][0-3][0-3]", last):
            turns.setdefault(stem, {})[last] = name
    alone = [stem for stem in positions if stem not in turns]
    others = [stem for stem in turns if stem not in positions]
    if len(alone) == len(others) == 1:
        # They are one pose, even if only its position names the body, as in tcp_x and yaw.
        turns[alone[0]] = turns.pop(others[0])
    for stem, three in positions.items():
        if len(three) == 3 and stem in turns:
            turned, convention = _turned(turns[stem])
            if turned:
                yield Body(place, stem, tuple(three[one] for one in "xyz"), turned, convention)


def _pose_words(name: str) -> list[str]:
    """Return the words of a name, those for desired poses first: x_ref has the words of ref_x."""
    words = words_of(name)
    parts = [part for word in words for part in re.findall("[A-Z]?[a-z0-9]+|[A-Z]+", word)]
    wanted = [part.lower() for part in parts if part.lower() in WANTED]
    return [*wanted, *(part for part in parts if part.lower() not in WANTED)] if wanted else words


def _turned(named: Mapping[str, str]) -> tuple[tuple[str, ...], str | None]:
    """Return the columns of a rotation, and its convention if the names tell it."""
    if all(f"q{one}" in named for one in "xyzw"):
        return tuple(named[f"q{one}"] for one in "xyzw"), "quaternion_xyzw"
    matrix = sorted(one for one in named if re.fullmatch("[rm][0-3][0-3]", one))
    if len(matrix) == 9:
        return tuple(named[one] for one in matrix), "matrix"
    for angles in (*ANGLES, ("qx", "qy", "qz")):
        if all(one in named for one in angles):
            if angles[0] == "rx" and "qw" in named:
                return (*(named[one] for one in angles), named["qw"]), "quaternion_xyzw"
            # The columns are often in the order of the turns, so they keep their order.
            return tuple(column for one, column in named.items() if one in angles), None
    return (), None


def axes_of(angles: Sequence[str]) -> str:
    """Return the axes of three angles by their names, such as "zyx", or "" if they tell none."""
    last = [(_pose_words(name) or [""])[-1].lower() for name in angles]
    for known in (*ANGLES, ("qx", "qy", "qz")):
        if set(last) == set(known):
            return "".join("xyz"[known.index(one)] for one in last)
    return ""


def joints_of(place: Place, robot: Robot) -> Iterator[Joints]:
    """Yield the groups of columns in a header that have one column for each joint."""
    groups: dict[str, dict[str, str]] = {}
    for name in place.header.names:
        if has_word(name, OTHERWISE) or re.search(r"[wxyz]$", without_unit(name).lower()):
            continue
        entry = re.fullmatch(r"(.*)\[([^\]]+)\]", name)
        numbered = re.fullmatch(r"(.*?)(\d+)(\D*)", without_unit(name))
        if entry:
            groups.setdefault(entry[1], {})[entry[2]] = name
        elif numbered:
            stem = f"{numbered[1]}{numbered[3]}".strip(" _.")
            groups.setdefault(stem, {})[numbered[2]] = name
    for stem, members in groups.items():
        if len(members) == robot.layout.joints:
            yield Joints(place, stem, tuple(members[key] for key in _in_order(members, robot)))


def _in_order(members: Mapping[str, str], robot: Robot) -> Sequence[str]:
    """Return the keys of joints in the order of the robot, of their numbers, or of the file."""
    if set(members) == set(robot.joint_names):
        return list(robot.joint_names)
    numbers = {key: re.findall(r"\d+", key) for key in members}
    if all(numbers.values()):
        return sorted(members, key=lambda key: int(numbers[key][-1]))
    return list(members)


def words_of(name: str) -> list[str]:
    """Return the words of a name without its unit."""
    return [word for word in re.split(r"[^A-Za-z0-9]+", without_unit(name)) if word]


def has_word(text: str, words: Sequence[str]) -> bool:
    """Return whether a text contains at least one of the words."""
    return bool(set(re.split(r"[^a-z]+", text.lower())) & set(words))


# Name with a unit at its end, after a separator or in brackets.
UNIT = re.compile(r"^(.*?)[\s_]*[\[(/_ ]\s*(" + "|".join(UNITS) + r")\s*[\])]?$", re.IGNORECASE)


def without_unit(name: str) -> str:
    """Return a name without the unit at its end."""
    found = UNIT.match(name)
    return found[1] if found and found[1] else name
