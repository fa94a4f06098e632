"""Arguments and options shared by several commands, shell completion, and output of results."""

import tomllib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from cmmsim.allowed_plugins import ALLOWED, allow_plugin, is_plugin_name
from identify.commands.kinds_of_files import check_kind
from identify.errors import ScenarioError
from identify.files.atomic import write_text
from identify.files.run_folder import as_json
from identify.progress import TYPED_PLUGINS
from identify.scenario import Scenario, load_scenario

# Package and folder of the built-in files of each kind.
BUILT_IN = {
    "robot": ("dynamics", "robots"),
    "sensor": ("cmmsim", "files/sensors"),
    "scenario": ("identify", "scenario/built_in"),
    "study": ("identify", "studies/built_in"),
}

STANDARD_OUTPUT = "-"  # file name that means standard output


def built_in_folder(kind: str) -> Path:
    """Return the folder of the built-in files of a kind.

    The package is only located and not imported, because shell completion must be fast.
    """
    package, folder = BUILT_IN[kind]
    spec = find_spec(package)
    return Path(str(spec and spec.origin)).parent / folder


def built_in_names(kind: str) -> list[str]:
    """Return the names of the built-in files of a kind, sorted."""
    return sorted(path.stem for path in built_in_folder(kind).glob("*.toml"))


def completion(kind: str) -> Callable[[str], list[str]]:
    """Return the shell completion for names and paths of this kind.

    The completion offers built-in names, TOML files, and folders.
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


def of_kind(kind: str) -> Callable[[str | None], str | None]:
    """Return a callback that refuses a file that is not of a kind. See `check_kind`."""

    def check(name: str | None) -> str | None:
        if name is not None:
            check_kind(kind, name)
        return name

    return check


def named(kind: str, help_: str | None = None, **more: Any) -> Any:
    """Return the argument for a built-in name of a kind or the path of a TOML file."""
    said = (
        help_ or f"Built-in {kind} ({', '.join(built_in_names(kind))}), or the path of a TOML file."
    )
    return typer.Argument(
        help=said, autocompletion=completion(kind), callback=of_kind(kind), **more
    )


def new_folder(default: str) -> Any:
    """Return the option for an output folder. Help shows `default` as the default value."""
    return typer.Option("--out", help="Output folder, new or empty.", show_default=default)


def repeatable(what: str, default: str) -> Any:
    """Return an option that can be given several times. Help shows `default` as its default."""
    return typer.Option(help=f"{what}; repeatable.", show_default=default)


def robot_option(what: str, default: str) -> Any:
    """Return the option for a robot. Help shows `default` as the default value."""
    return typer.Option(
        "--robot",
        metavar="NAME|FILE",
        help=what,
        show_default=default,
        autocompletion=completion("robot"),
        callback=of_kind("robot"),
    )


RobotArgument = Annotated[str, named("robot")]
SensorArgument = Annotated[str, named("sensor")]
ScenarioArgument = Annotated[str, named("scenario")]
RobotOption = Annotated[
    str | None, robot_option("Robot in place of the scenario's robot.", "scenario's")
]
NewFolder = Annotated[Path | None, new_folder("runs/SCENARIO-SEED")]
RunFolderOption = Annotated[
    Path, typer.Option("--out", help="Folder of the run, with the files of the stage before.")
]
WholeRunOption = Annotated[
    Path, typer.Option("--out", help="Folder of a finished run, as cmmsim run writes it.")
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
        help="Replace a value of the scenario: timing.frame_rate_hz=30; repeatable. The file that "
        "cmmsim new scenario FILE writes lists all keys.",
    ),
]
EstimatorSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a setting of the estimator, in the sections identification, model or filter "
        "of the scenario: identification.method=command_driven; repeatable. Other sections cannot "
        "change, because the record was made with them.",
    ),
]
MOST_WORKERS = 1000  # largest number of processes that a command starts

Workers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        max=MOST_WORKERS,
        help="Number of processes that render.",
        show_default="one per core",
    ),
]
Quiet = Annotated[
    bool,
    typer.Option("--quiet", help="Print no progress bars and no tables, only warnings."),
]
Strict = Annotated[
    bool,
    typer.Option("--strict", help="End with exit status 4 if a goal is missed."),
]


def _allow(modules: list[str] | None) -> None:
    allow_plugin(*modules or ())
    TYPED_PLUGINS[:] = modules or ()


# Modules of the user's own parts, which are allowed before any other option is read.
Plugins = Annotated[
    list[str] | None,
    typer.Option(
        "--plugin",
        metavar="MODULE",
        is_eager=True,
        callback=_allow,
        help="Module of your own that is allowed to be imported: files and options then name its "
        f"parts as module:function; repeatable. The variable {ALLOWED} names such modules for all "
        "commands.",
    ),
]


def allow_named(names: list[str] | None) -> None:
    """Allow the modules of parts that an option names as ``module:function``."""
    allow_plugin(*(name.partition(":")[0] for name in names or () if is_plugin_name(name)))


JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the results as JSON into this file, which is replaced if it exists; "
        "- prints the JSON in place of the tables.",
    ),
]


def tell(
    entry: dict[str, Any], json_file: Path | None, quiet: bool, say: Callable[[], None]
) -> None:
    """Output the results of a command: as JSON if requested, and as text unless `quiet`.

    `say` prints the text, unless the JSON is printed. Raises WriteError.
    """
    if str(json_file) == STANDARD_OUTPUT:
        typer.echo(as_json(entry), nl=False)
        return
    if json_file is not None:
        write_text(json_file, as_json(entry), parents=True)
    if not quiet:
        say()


# Kind of a value and its last letter, by the first letter.
BRACKETS = {"[": ("list", "]"), "{": ("table", "}")}


def parse_settings(settings: list[str] | None) -> dict[str, Any]:
    """Return overrides from ``KEY=VALUE`` texts.

    A value is read as TOML. If that fails, it is a string.

    Raises ScenarioError for a text without ``=``, and for a list or table that is not TOML.
    """
    overrides = {}
    for text in settings or []:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ScenarioError(
                f"--set {text!r} is not of the form KEY=VALUE, such as timing.frame_rate_hz=30"
            )
        overrides[key.strip()] = value = _toml_or_text(value.strip())
        if isinstance(value, str) and value[:1] in BRACKETS:
            what, closing = BRACKETS[value[0]]
            raise ScenarioError(
                f"--set {text!r}: "
                + (
                    f"{value!r} is not TOML; put texts within it in double quotes"
                    if value.endswith(closing)
                    else f"a {what} needs its closing bracket {closing}"
                )
            )
    return overrides


def chosen_scenario(name: str, settings: list[str] | None, robot: str | None) -> Scenario:
    """Load the scenario of this name or path, with replaced values and, if given, another robot.

    Raises ScenarioError if there is no such scenario or if a setting is invalid.
    """
    check_kind("scenario", name)
    chosen = {} if robot is None else {"robot": robot}
    return load_scenario(name).with_overrides(chosen | parse_settings(settings))


def _toml_or_text(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    # Deeply nested brackets exceed the recursion limit of the parser.
    except (ValueError, RecursionError):
        return text
