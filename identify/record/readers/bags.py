"""Bags of ROS 2: folders, or files as MCAP or SQLite, read by the package rosbags.

A column is a path in a message, such as ``pose.position.x``. An entry of an array is given by its
number in brackets, or by the name of its joint or frame: ``position[crank1]``,
``transforms[plate].transform.rotation.w``. The column ``log_time`` is the time at which a message
was written into the bag.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from identify.errors import RecordError
from identify.files.limited_process import UntrustedFileError, within_limits
from identify.record.readers.bag_messages import list_topics, read_messages
from identify.record.readers.streams import Header, Stream, check_columns
from identify.record.telemetry import Rows

SUFFIXES = (".mcap", ".db3")

METADATA = "metadata.yaml"  # file in the folder of a bag that lists its other files
LARGEST_METADATA = 1_000_000  # largest size of that file, bytes
LIMIT_S = 120  # time limit for reading a topic, s. Bags with images are large.


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a file with one of SUFFIXES, or a folder with METADATA."""
    return path.suffix.lower() in SUFFIXES or (path / METADATA).is_file()


@dataclass(frozen=True)
class Bag:
    """Bag whose topics can be read by name.

    Another process reads it, within limits, because it can come from an untrusted source.
    """

    path: Path

    @cached_property
    def headers(self) -> Mapping[str, Header]:
        """Headers of the topics. Raises RecordError if the bag cannot be read."""
        found: dict[str, tuple[str, tuple[str, ...]]] = self._within_limits(list_topics)
        return {topic: Header(names, kind) for topic, (kind, names) in found.items()}

    def read(self, topic: str, names: Sequence[str]) -> Stream:
        """Read columns of a topic, without messages that have none of them.

        Raises RecordError if the bag cannot be read or no message has any of the columns. If the
        topic lacks a column, the error names those that it has.
        """
        header = self.headers[topic]
        check_columns(header, names, f"{self.path} {topic}")
        numbers, columns = self._within_limits(read_messages, topic, tuple(names))
        if not numbers:
            raise RecordError(f"{self.path} {topic} has no messages with {', '.join(names)}")
        return Stream(
            dict(zip(names, columns, strict=True)),
            Rows(f"{self.path} {topic}", numbers, "message"),
        )

    def _within_limits(self, read: Callable[..., Any], *given: object) -> Any:
        _check_installed()
        if not self.path.exists():
            raise RecordError(f"there is no file {self.path}")
        about = self.path / METADATA
        if about.is_file() and about.stat().st_size > LARGEST_METADATA:
            raise RecordError(f"{about} has more than {LARGEST_METADATA:,} bytes")
        try:
            return within_limits(read, self.path.resolve(), *given, limit_s=LIMIT_S)
        except UntrustedFileError as error:
            raise RecordError(f"cannot read the bag {self.path}: {error}") from None


def _check_installed() -> None:
    try:
        import rosbags  # noqa: F401
    except ImportError:
        raise RecordError(
            "a bag is read by the package rosbags, which is not installed: pip install "
            "'cmmsim[bags]'"
        ) from None
