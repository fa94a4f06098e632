"""Arguments and options shared by several commands, shell completion, and output of figures."""

import tomllib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from cmmsim.allowed_plugins import ALLOWED, allow_plugin, is_own
from identify.errors import ScenarioError
from identify.files.atomic import write_text
from identify.files.run_folder import as_json
from identify.scenario import Scenario, load_scenario

BUILT_IN = {
    "robot": ("dynamics", "robots"),
    "sensor": ("cmmsim", "files/sensors"),
    "scenario": ("identify", "scenario/built_in"),
    "study": ("identify", "studies/built_in"),
}
"""Package and folder of the built-in files of each kind."""

STANDARD_OUTPUT = "-"
"""Name that stands for standard output in place of a file."""


def built_in_folder(kind: str) -> Path:
    """Return the folder of the built-in files of a kind.

    Its package is not imported, since a shell waits for completions.
    """
    package, folder = BUILT_IN[kind]
    spec = find_spec(package)
    return Path(str(spec and spec.origin)).parent / folder


def built_in_names(kind: str) -> list[str]:
    """Return the names of the built-in files of a kind, sorted."""
    return sorted(path.stem for path in built_in_folder(kind).glob("*.toml"))


def completion(kind: str) -> Callable[[str], list[str]]:
    """Return the completion of a name or path of this kind for a shell.

    It offers built-in names, TOML files, and folders to look into.
    """

    def offered(incomplete: str) -> list[str]:
        typed = Path(incomplete)
        folder = typed if incomplete.endswith("/") else typed.parent
        beside = sorted(folder.glob("*")) if folder.is_dir() else []
        paths = [
            f"{path}/" if path.is_dir() else str(path)
            for path in beside
            if path.is_dir() or path.suffix == ".toml"
        ]
        return [name for name in [*built_in_names(kind), *paths] if name.startswith(incomplete)]

    return offered


def named(kind: str, help_: str | None = None, **more: Any) -> Any:
    """Return the argument for a built-in name of a kind or the path of a TOML file."""
    said = (
        help_ or f"Built-in {kind} ({', '.join(built_in_names(kind))}), or the path of a TOML file."
    )
    return typer.Argument(help=said, autocompletion=completion(kind), **more)


def new_folder(default: str) -> Any:
    """Return the option of a folder to write into. `default` is the default's name in help."""
    return typer.Option("--out", help="Output folder, new or empty.", show_default=default)


def repeatable(what: str, default: str) -> Any:
    """Return an option that may be given several times. `default` is the default's name in help."""
    return typer.Option(help=f"{what}; repeatable.", show_default=default)


RobotArgument = Annotated[str, named("robot")]
SensorArgument = Annotated[str, named("sensor")]
ScenarioArgument = Annotated[str, named("scenario")]
RobotOption = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar="NAME|FILE",
        help="Another robot than the scenario's.",
        show_default="scenario's",
        autocompletion=completion("robot"),
    ),
]
NewFolder = Annotated[Path | None, new_folder("runs/SCENARIO-SEED")]
RunFolderOption = Annotated[
    Path, typer.Option("--out", help="Folder of the run, as the stage before left it.")
]
WholeRunOption = Annotated[
    Path, typer.Option("--out", help="Folder of a whole run, as cmmsim run leaves it.")
]
Seed = Annotated[
    int,
    typer.Option("--seed", min=0, help="Seed of all randomness: trajectories and sensor noise."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a value of the scenario: timing.frame_rate_hz=30; repeatable. What cmmsim "
        "new scenario FILE writes has all keys.",
    ),
]
EstimatorSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a setting of the estimator, in the sections identification, model or filter "
        "of the scenario: "
        "identification.method=command_driven; repeatable. The record was made with the rest.",
    ),
]
MOST_WORKERS = 1000
"""Largest number of processes that a command starts."""

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        max=MOST_WORKERS,
        help="Processes that render.",
        show_default="one a core",
    ),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", help="No progress bars and no tables; warnings stay.")
]


def _allow(modules: list[str] | None) -> None:
    allow_plugin(*modules or ())


Plugins = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        metavar="MODULE",
        is_eager=True,
        callback=_allow,
        help="Module of your own whose parts files and options may name as module:function; "
        f"repeatable. {ALLOWED} names such modules for all commands.",
    ),
]
"""Modules that parts of a user's own may come from. They are allowed as soon as they are read."""


def allow_named(names: list[str] | None) -> None:
    """Allow the modules of parts that the user has typed as ``module:function`` in an option."""
    allow_plugin(*(name.partition(":")[0] for name in names or () if is_own(name)))


JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the figures as JSON into this file, replaced if there; - prints them in "
        "place of the tables.",
    ),
]


def tell(
    entry: dict[str, Any], json_file: Path | None, quiet: bool, say: Callable[[], None]
) -> None:
    """Hand out a command's figures: as JSON if it is asked for, and in words unless `quiet`.

    `say` prints the words. Raises WriteError if the file cannot be written.
    """
    if str(json_file) == STANDARD_OUTPUT:
        typer.echo(as_json(entry), nl=False)
        return
    if json_file is not None:
        write_text(json_file, as_json(entry), parents=True)
    if not quiet:
        say()


def parse_settings(settings: list[str] | None) -> dict[str, Any]:
    """Return overrides from ``KEY=VALUE`` texts. A value is TOML, or else a string.

    Raises ScenarioError for a text without ``=``.
    """
    overrides = {}
    for text in settings or []:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ScenarioError(
                f"--set {text!r} is not of the form KEY=VALUE, such as timing.frame_rate_hz=30"
            )
        overrides[key.strip()] = _toml_or_text(value.strip())
    return overrides


def chosen_scenario(name: str, settings: list[str] | None, robot: str | None) -> Scenario:
    """Load the scenario of a name or path, with values replaced, and with another robot if named.

    Raises ScenarioError if there is no such scenario, or for a setting that it cannot have.
    """
    chosen = {} if robot is None else {"robot": robot}
    return load_scenario(name).with_overrides(chosen | parse_settings(settings))


def _toml_or_text(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    # Deeply nested brackets exceed the recursion limit of the parser.
    except (ValueError, RecursionError):
        return text
