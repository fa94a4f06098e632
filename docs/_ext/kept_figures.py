"""Tables of the figures of kept runs, which are in .readme/*.json. `page_blocks.py` puts them into
the pages.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from answer_figures import Middle, Point

from identify.accuracy.saved import read_saved
from identify.accuracy.session import markdown_table
from identify.reporting.tables import excitation_error_table, goals_table
from identify.studies.study_file import STUDIES, load_study

LAWS = "test_rows_of_a_study_follow_its_laws"
WORST = "unseen_position_um_"
SMALLEST = 0.001  # figures below it are only said to be below it
ESTIMATED = {
    "groups_percent": "error of groups, %",
    "gains_percent": "error of gains, %",
    "position_um": "largest position error, µm",
    "orientation_urad": "largest orientation error, µrad",
    "seconds": "time, s",
}
"""What is told of an estimator."""


def kept(folder: Path, name: str) -> dict[str, Any]:
    """Content of a kept file."""
    return dict(json.loads((folder / f"{name}.json").read_text(encoding="utf-8")))


def figures_of(content: dict[str, Any], part: str = "") -> dict[str, float]:
    """Figures by name of all tests that passed, of those whose name holds ``part``."""
    return {
        name: value
        for test, entry in content["tests"].items()
        if part in test and entry["outcome"] == "passed"
        for name, value in entry["figures"].items()
    }


def date_of(content: dict[str, Any], part: str = "") -> str:
    """Date of the last of the tests whose name holds ``part``."""
    return max(entry["date"] for test, entry in content["tests"].items() if part in test)


def goals(folder: Path) -> str:
    """Goals of the kept run of the scenario `paper`."""
    text = str(goals_table(kept(folder, "result")).markdown())
    return text.replace("| --: |\n", "| --- |\n", 1)  # the last column holds sentences


def excitation_errors(folder: Path) -> str:
    """Model against measurement on the exciting trajectory, beside the paper's table 3."""
    return str(excitation_error_table(kept(folder, "result"), repeats_paper=True).markdown())


def accuracy(folder: Path) -> str:
    """This project's own accuracy figures, in the units and words of the pages."""
    saved = read_saved(folder / "accuracy.json")
    table = str(markdown_table(saved.figures))
    # The page names the figures without their tests, but with the parameters of a test.
    row = re.compile(r"^\| [^|[]*(\[\w+\])? \| ([^|]*) \|", re.MULTILINE)
    text = row.sub(lambda found: f"| {found[2]}{found[1] or ''} |", table)
    words = {
        "95% interval": "95 % interval",
        "| um |": "| µm |",
        "| urad |": "| µrad |",
        "[planes]": ", by planes",
        "[registration]": ", by registration",
        "starting model on unseen motion": "initial model and ideal sensor, further motions",
        "identified model on unseen motion": "identified model and ideal sensor, further motions",
    }
    for old, new in words.items():
        text = text.replace(old, new)
    text = re.sub(r"(\d)% \|", r"\1 % |", text)
    return f"{text.rstrip()}\n\nMeasured {saved.created[:10]}.\n"


def sensor_speed(folder: Path) -> str:
    """Stereo frames a second, and against the straightforward pipeline."""
    found = figures_of(kept(folder, "speeds"), "test_sensor_speed")
    renderers = ("analytic", "pyrender")
    titles = {
        "frames_a_second": "stereo frames per second, drawn and measured",
        "times_straightforward": "speed relative to the straightforward pipeline",
    }
    rows = [
        (title, *(f"{found[f'{renderer}_{name}']:.0f}" for renderer in renderers))
        for name, title in titles.items()
    ]
    others = {
        "images_together": "`analytic`, many at once, on all cores",
        "without_images": "`statistical`, many at once, on all cores",
    }
    more = [(title, f"{found[f'{name}_frames_a_second']:,.0f}") for name, title in others.items()]
    table = _table(("renderer", "`analytic`", "`pyrender`"), rows)
    return f"{table}\n\n{_table(('renderer', 'frames per second'), more)}" + _measured(
        folder, "test_sensor_speed"
    )


def dynamics_speed(folder: Path) -> str:
    """The dynamics against other engines."""
    found = figures_of(kept(folder, "speeds"), "test_dynamics_speed")
    shown: list[tuple[str, str, Callable[[float], str]]] = [
        ("forward dynamics against Pinocchio's closed chain, relative "
         "difference", "pinocchio_relative_difference",
         lambda value: f"{value:.0e}"),
        ("forward dynamics against Pinocchio's "
         "`constraintDynamics`", "forward_dynamics_over_pinocchio", _faster),
        ("forward dynamics against MuJoCo's `mj_step`", "forward_dynamics_over_mj_step", _faster),
        ("simulating a closed loop without images: exact stick-slip friction, 60 Hz frames",
         "times_real_time", lambda value: f"{value:.0f} times as fast as real time"),
        ("the same run with its derivatives by all 67 parameters", "sensitivities_plain_runs",
         lambda value: f"takes {value:.1f} times as long"),
        ("a batch of runs on two cores", "two_cores_gain", lambda value: f"{value:.2f} times "
                                                                         "as fast as on one"),
        ("compiling a robot, at first use", "robot_compilation_s", lambda value: f"{value:.0f} s"),
        ("compiling the loop, once after "
         "installation", "loop_compilation_s", lambda value: f"{value:.0f} s"),
    ]  # fmt: skip
    rows = [(title, text(found[name])) for title, name, text in shown]
    return _table(("figure", "measured"), rows) + _measured(folder, "test_dynamics_speed")


def robots(folder: Path) -> str:
    """What `cmmsim run quick` reached with each built-in robot."""
    thorough = kept(folder, "thorough")
    found = figures_of(thorough, "test_families")
    names = sorted(name.removeprefix(WORST) for name in found if name.startswith(WORST))
    rows = [
        (
            f"`{name}`",
            f"{found[WORST + name]:.2f}",
            f"{urad:.1f}"
            if (urad := found[f"unseen_orientation_urad_{name}"])
            else "does not turn",
        )
        for name in names
    ]
    heads = ("robot", "position error, µm", "orientation error, µrad")
    return _table(heads, rows) + f"\n\nMeasured {date_of(thorough, 'test_families')}.\n"


def laws(folder: Path) -> str:
    """The laws of the built-in studies, with the exponents measured at full count."""
    thorough = kept(folder, "thorough")
    found = figures_of(thorough, LAWS)
    rows = []
    for name in STUDIES.names():
        for number, law in enumerate(load_study(name).theory):
            key = f"law {name} {number}"
            measured = ""
            if f"{key} measured" in found:
                middle, low, high = (
                    found[f"{key} {figure}"] for figure in ("measured", "low", "high")
                )
                measured = f"{middle:.3f} ({low:.3f} to {high:.3f})"
            statement = law.statement.replace("_", "\\_").replace("^", "\\^").replace("~", "\\~")
            rows.append((f"`{name}`", f"{statement}: {law.why.replace('^', '&#94;')}", measured))
    when = f"\n\nMeasured {date_of(thorough, LAWS)}.\n"
    heads = ("study", "law and reason", "measured exponent, 99 % interval")
    return _table(heads, rows, "---") + when


def answer(name: str, factors: dict[str, str], shown: dict[str, str]) -> Callable[[Path], str]:
    """The table of a built-in study that asks a question, of its kept summary: factors and figures
    with their heads.
    """
    return answers({name: ()}, (), factors, shown)


def answer_points(
    folder: Path, name: str, factors: dict[str, str], shown: dict[str, str]
) -> list[Point]:
    """The same as numbers."""
    return [
        (
            tuple(point["factors"][path] for path in factors),
            {
                figure: _middle(figure, point["figures"])
                for figure in shown
                if figure in point["figures"]
            },
        )
        for point in kept(folder / "answers", name)["points"]
    ]


def answers(
    kept_as: dict[str, tuple[str, ...]],
    heads: tuple[str, ...],
    factors: dict[str, str],
    shown: dict[str, str],
) -> Callable[[Path], str]:
    """The same of several kept summaries, each with what its rows have in common, under these
    heads.
    """

    def table(folder: Path) -> str:
        contents = {name: kept(folder / "answers", name) for name in kept_as}
        rows = [
            (
                *kept_as[name],
                *(str(point["factors"][path]) for path in factors),
                *(_average(figure, point["figures"]) for figure in shown),
            )
            for name, content in contents.items()
            for point in content["points"]
        ]
        return _table((*heads, *factors.values(), *shown.values()), rows) + _kept_rows(
            folder, contents
        )

    return table


def leaderboard(folder: Path) -> str:
    """Median errors of the ten estimators, rms over the kept experiments."""
    rows = [
        (f"`{name}`", *(_text(found.get(end)) for end in ESTIMATED))
        for (name,), found in leaderboard_points(folder)
    ]
    contents = {"estimators": kept(folder / "answers", "estimators")}
    return _table(("estimator", *ESTIMATED.values()), rows) + _kept_rows(folder, contents)


def leaderboard_points(folder: Path) -> list[Point]:
    """The same as numbers."""
    (point,) = kept(folder / "answers", "estimators")["points"]
    found, end = point["figures"], "_position_um"
    names = [name.removesuffix(end) for name in found if name.endswith(end)]
    return [
        (
            (name,),
            {end: _middle(f"{name}_{end}", found) for end in ESTIMATED if f"{name}_{end}" in found},
        )
        for name in names
    ]


def _average(name: str, figures: dict[str, Any]) -> str:
    """Mean of shares, counts, ratios and differences, rms of all else, with its 95 % band."""
    return _text(_middle(name, figures) if name in figures else None)


def _middle(name: str, figures: dict[str, Any]) -> Middle:
    ends = ("intervals", "groups", "ratio", "normalised_error")
    kind = "mean" if "covered" in name or "excess" in name or name.endswith(ends) else "rms"
    return figures[name][kind], figures[name][f"{kind}_band"]


def _text(figure: Middle | None) -> str:
    if figure is None:
        return "none"
    middle, band = figure
    if 0 < middle < SMALLEST:
        return f"below {SMALLEST}"
    low, high = (middle, middle) if band is None else band
    shown = [_three_digits(value) for value in (middle, low, high)]
    return shown[0] if len(set(shown)) == 1 else f"{shown[0]} ({shown[1]} to {shown[2]})"


def _three_digits(value: float) -> str:
    return f"{float(f'{value:.3g}'):.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _kept_rows(folder: Path, contents: dict[str, dict[str, Any]]) -> str:
    """How many rows answers have, by their names, and with which commands: those of
    `.ci/answers`."""
    done, failed = (
        sum(content["rows"][what] for content in contents.values()) for what in ("done", "failed")
    )
    lost, seed = f"; {failed} failed" if failed else "", next(iter(contents.values()))["seed"]
    lines = (folder / "answers" / "commands.txt").read_text(encoding="utf-8").splitlines()
    renewed = dict(line.split(" ", 1) for line in lines)
    commands = ", ".join(f"`cmmsim study {renewed[name]}`" for name in contents)
    return f"\n\n{done} experiments{lost}, seed {seed}; {commands}.\n"


def _faster(value: float) -> str:
    return f"{value:.1f} times as fast"


def _measured(folder: Path, part: str) -> str:
    """When, and with which versions of the packages that a benchmark names."""
    content = kept(folder, "speeds")
    entries = [content | entry for test, entry in content["tests"].items() if part in test]
    versions = {name: version for entry in entries for name, version in entry["versions"].items()}
    with_what = ", ".join(
        f"{name} {versions[name]}"
        for name in ("pin", "mujoco", "opencv-python-headless", "pyrender")
        if name in versions
    )
    return f"\n\nMeasured {date_of(content, part)} with {with_what}, on {content['cores']} cores.\n"


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]], rule: str = "--:") -> str:
    lines = [head, ("---", *(rule for _ in head[1:])), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
