"""Kinds of TOML files, so that a command can say how to use a file that is not of its kind."""

from pathlib import Path

from identify.errors import IdentifyError, ScenarioError

# Keys at the top level that tell the kind of a file. Each file has one of those of its kind, but a
# scenario can have its name alone. A description also has keys of a scenario, and is thus first.
KEYS = {
    "description of a log": {"record", "columns"},
    "robot": {"home_pose", "travel_limit", "legs", "family"},
    "sensor": {"based_on", "camera", "stickers", "platform"},
    "study": {"factors", "changes", "repeats", "kind"},
    "scenario": {"robot", "servo", "plant", "model", "excitation", "identification", "validation"},
}
# Commands that use a file of a kind.
USES = {
    "description of a log": "cmmsim check LOG, and cmmsim identify --record LOG, where LOG is the "
    "log beside it, or {0} if it names its log",
    "robot": "cmmsim check {0}, and cmmsim run quick --robot {0}",
    "sensor": "cmmsim acceptance {0}, and cmmsim run quick --set sensor={0}",
    "study": "cmmsim study {0}",
    "scenario": "cmmsim run {0}",
}


def check_kind(kind: str, name: str) -> None:
    """Raise ScenarioError if a TOML file is of another kind, and name the commands that use it.

    Nothing is raised for a file that cannot be read or that has keys of no kind. Its reader says
    more about it.
    """
    from dynamics.files import is_file, parse_toml, read_text

    if Path(name).suffix != ".toml" or not is_file(name):
        return
    try:
        keys = parse_toml(read_text(name, name, IdentifyError), name, IdentifyError).keys()
    except IdentifyError:
        return
    kinds = [found for found, own in KEYS.items() if own & keys]
    if not kinds or kinds[0] == kind or (kind in kinds and kind != "scenario"):
        return
    found = kinds[0]
    raise ScenarioError(
        f"{name} is a {found} and not a {kind}; it is used by: {USES[found].format(name)}"
    )
