"""Messages of a bag as columns of numbers.

Another process runs these functions, within limits. They therefore import few modules.
"""

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

LOG_TIME = "log_time"

LISTED = 8  # number of messages of a topic that are searched for the names of its entries
MOST = 500  # largest number of columns of a topic, and of listed entries of an array
NAMES = ("name", "joint_names")  # entries of a message that name those of its arrays
CHILD = "child_frame_id"  # entry that names a transform among several
# Name of an entry of a message, and what stands in brackets behind it, or None.
Step = tuple[str, str | None]
# Number of a message, time as text, or None where a message has no such entry.
Entry = str | float | None


def list_topics(path: Path) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the type of the messages of each topic, and the names of their columns.

    Raises the exceptions of rosbags.
    """
    found = {}
    with _opened(path) as bag:
        for topic, connection in sorted(bag.topics.items()):
            names: dict[str, None] = {LOG_TIME: None}
            kind = str(connection.msgtype)
            # The keys of a dictionary keep the order of the message, without duplicates.
            for _, message in islice(_messages(bag, topic), LISTED):
                names |= dict.fromkeys(islice(_columns(message, message), MOST))
            found[topic] = kind.replace("/msg/", "/"), tuple(names)
    return found


def read_messages(
    path: Path, topic: str, names: Sequence[str]
) -> tuple[list[int], list[list[Entry]]]:
    """Return the numbers, from 1, of the messages that have any of the columns, and the columns.

    A message that has only the times among them is left out, unless only times are read. Times are
    seconds, as text with all their digits. Raises the exceptions of rosbags.
    """
    paths = [_steps(name) for name in names]
    # Every message has a time, so times do not show whether the message has an entry.
    telling = [index for index, name in enumerate(names) if not _is_time(name)]
    numbers: list[int] = []
    columns: list[list[Entry]] = [[] for _ in names]
    with _opened(path) as bag:
        for number, (moment, message) in enumerate(_messages(bag, topic), start=1):
            cells = [
                _seconds(moment) if name == LOG_TIME else _entry(message, steps)
                for name, steps in zip(names, paths, strict=True)
            ]
            if telling and all(cells[index] is None for index in telling):
                continue
            numbers.append(number)
            for column, cell in zip(columns, cells, strict=True):
                column.append(cell)
    return numbers, columns


def _opened(path: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # Older bags do not hold the definitions of their messages.
    return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _messages(bag: Any, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield the time, ns, and the content of each message of a topic."""
    connections = [one for one in bag.connections if one.topic == topic]
    for connection, moment, raw in bag.messages(connections=connections):
        yield moment, bag.deserialize(raw, connection.msgtype)


def _is_time(name: str) -> bool:
    return name == LOG_TIME or name.endswith("stamp")


def _seconds(nanoseconds: int) -> str:
    whole, rest = divmod(nanoseconds, 1_000_000_000)
    return f"{whole}.{rest:09d}"


def _steps(name: str) -> list[Step]:
    """Return the steps of a path in a message."""
    # Names in brackets can have dots and slashes.
    found = re.findall(r"([^.\[\]]+)(?:\[([^\]]*)\])?(?:\.|$)", name)
    return [(entry, key or None) for entry, key in found]


def _entry(message: Any, steps: Sequence[Step]) -> Entry:
    """Return the number or time at a path in a message, or None if the message has none there."""
    value = message
    for name, key in steps:
        value = getattr(value, name, None)
        if key is not None and value is not None:
            index = _place(message, value, key)
            value = value[index] if index is not None and index < len(value) else None
    if hasattr(value, "nanosec"):
        return _seconds(value.sec * 1_000_000_000 + value.nanosec)
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError):
        return None


def _place(message: Any, values: Sequence[Any], key: str) -> int | None:
    """Return the index of an array's entry with this number or name, or None if there is none."""
    if len(values) and hasattr(values[0], CHILD):
        return next((k for k, one in enumerate(values) if getattr(one, CHILD) == key), None)
    names = _named(message, len(values))
    if key in names:
        return names.index(key)
    return int(key) if key.isdecimal() and not names else None


def _named(message: Any, count: int) -> list[str]:
    """Return the names of the entries of an array of this length, or an empty list."""
    for name in NAMES:
        found = getattr(message, name, None)
        if isinstance(found, list) and len(found) == count:
            return found
    return []


def _columns(message: Any, value: Any, path: str = "") -> Iterator[str]:
    """Yield the paths of the numbers in a message."""
    if hasattr(value, "nanosec"):
        yield path
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            if not name.startswith("__"):
                yield from _columns(message, getattr(value, name), f"{path}.{name}".lstrip("."))
    elif isinstance(value, (bool, int, float)):
        yield path
    elif hasattr(value, "__len__") and not isinstance(value, (str, bytes)):
        names = _named(message, len(value))
        for index, one in enumerate(islice(value, MOST)):
            key = getattr(one, CHILD, names[index] if names else str(index))
            yield from _columns(message, _plain(one), f"{path}[{key}]")


def _plain(value: Any) -> Any:
    """Return an entry of an array, with a NumPy number converted to a Python number."""
    return value.item() if hasattr(value, "item") else value
