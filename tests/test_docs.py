"""The documentation can be followed: its commands exist with their options and settings, its links
and files do.
"""

import importlib
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest
import typer.main

from identify.commands.app import app
from identify.commands.options import parse_settings
from identify.scenario import load_scenario, scenario_names

ROOT = Path(__file__).parent.parent
PAGES = [path for path in sorted((ROOT / "docs").rglob("*.md")) if "generated" not in path.parts]
TEXTS = {
    path: path.read_text(encoding="utf-8")
    for path in (*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md")
}


@pytest.fixture
def page_blocks(monkeypatch):
    """The module that writes the blocks of pages."""
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    return importlib.import_module("page_blocks")


def commands(text):
    """The command lines of ``cmmsim`` in blocks of a shell and between backquotes, as lists of
    words.
    """
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`((?:\.venv/bin/)?cmmsim [^`]+)`", text)
    for line in lines:
        for part in line.split("&&"):
            words = shlex.split(part, comments=True)
            if words and words[0].removeprefix(".venv/bin/") == "cmmsim":
                yield words[1:]


def parsed(words):
    """Name and values of a command line. Raises what the command line itself refuses."""
    command, name = typer.main.get_command(app), "cmmsim"
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        assert words[0] in command.commands, f"no command {words[0]!r}"
        name, command, words = words[0], command.commands[words[0]], words[1:]
    return name, command.make_context(name, list(words)).params if words else {}


ANSWERS = ROOT / ".readme" / "answers" / "commands.txt"
RENEWED = {
    name: words for name, *words in map(str.split, ANSWERS.read_text(encoding="utf-8").splitlines())
}
FOUND = [(path, words) for path, text in TEXTS.items() for words in commands(text)]
FOUND += [(ANSWERS, ["study", *words]) for words in RENEWED.values()]


def test_every_kept_answer_has_the_command_of_its_study():
    kept = {
        path.stem: json.loads(path.read_text(encoding="utf-8"))["name"]
        for path in ANSWERS.parent.glob("*.json")
    }
    assert kept == {name: study for name, (study, *_) in RENEWED.items()}


def test_every_command_line_is_one_that_the_program_takes():
    """A command alone, as it is mentioned in a sentence, must exist; one with arguments must
    parse."""
    assert len(FOUND) > 100
    wrong = []
    for path, words in FOUND:
        if {"--help", "COMMAND", "--install-completion"} & set(words):
            continue
        try:
            name, values = parsed(words)
            scenario = values.get("scenario")
            if name in ("run", "excite") and scenario in scenario_names():
                settings = parse_settings(values.get("settings"))
                own = {
                    key: value for key, value in settings.items() if str(value).endswith(".toml")
                }
                load_scenario(scenario).with_overrides(
                    {k: v for k, v in settings.items() if k not in own}
                )
        except (Exception, SystemExit) as error:
            wrong.append(f"{path.relative_to(ROOT)}: cmmsim {shlex.join(words)}: {error}")
    assert not wrong, "\n".join(wrong)


def test_each_equation_of_the_paper_names_code_and_a_test_and_each_exhibit_a_command():
    """The paper has equations 1 to 40 and A1 to A6, thirteen figures and five tables."""
    text = (ROOT / "docs" / "reference" / "paper.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| `([\w.]+)` \|$", text, re.MULTILINE)
    tests = re.findall(r"^- (.+): `(\w+)` in `([\w/.]+)`$", text, re.MULTILINE)
    assert [said for said, _ in rows] == [said for said, _, _ in tests]

    def counted(one):
        first, _, last = one.partition(" to ")
        letter, *numbers = first.rstrip("0123456789"), *re.findall(r"\d+", one)
        assert not last or last.startswith(letter)
        return [f"{letter}{k}" for k in range(int(numbers[0]), int(numbers[-1]) + 1)]

    said = [one for cell, _ in rows for one in cell.split(", ") if "section" not in one]
    equations = [number for one in said for number in counted(one)]
    wanted = [*map(str, range(1, 41)), *(f"A{k}" for k in range(1, 7))]
    assert sorted(equations) == sorted(wanted)
    for _, function in rows:
        resolve_name(function)
    for _, test, file in tests:
        source = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {test}\(", source, re.MULTILINE), f"{file}::{test}"
    exhibits = re.findall(
        r"^\| ((?:Figure|Table) \d+) \| [^|]+ \| `cmmsim [^`]+` \|$", text, re.MULTILINE
    )
    assert exhibits == [f"Figure {k}" for k in range(1, 14)] + [f"Table {k}" for k in range(1, 6)]


def test_every_link_and_every_file_that_is_named_exists():
    """What a page includes from the build is checked by the build itself."""
    wrong = []
    for path, text in TEXTS.items():
        targets = re.findall(r"\]\(([^)#\s]+)", text)
        targets += re.findall(r"^```\{include\} (\S+)", text, re.MULTILINE)
        wrong += [
            f"{path.relative_to(ROOT)}: {target}"
            for target in targets
            if not target.startswith(("http", "../generated/"))
            and not (path.parent / target).exists()
        ]
        named = re.findall(
            r"`(?:sh )?((?:cmmsim|dynamics|identify|tests|docs|\.ci|\.readme)/[\w./]*)`", text
        )
        wrong += [
            f"{path.relative_to(ROOT)}: {name}" for name in named if not (ROOT / name).exists()
        ]
    assert [one for one in wrong if not one.endswith("tests/FILE.py")] == []


def test_a_page_can_be_read_where_nothing_builds_it(page_blocks):
    """What only the build can read stands in comments, which a code host hides. What a page shows
    of the code, of kept figures and of files stands in it: `python docs/_ext/page_blocks.py` renews
    it.
    """
    raw = r"\{\{|^:::|^```\{|generated/"
    wrong = []
    for path in PAGES:
        text = re.sub(r"^<!-- for the build\n.*?^-->$", "", TEXTS[path], flags=re.M | re.S)
        wrong += [f"{path}: {found[0]}" for found in re.finditer(raw, text, re.MULTILINE)]
        if page_blocks.renewed(path, TEXTS[path]) != TEXTS[path]:
            wrong.append(f"{path}: a block that differs from what it shows")
    for path, content in page_blocks.answer_pictures().items():
        if page_blocks.drawn_from(path) != page_blocks.digest(content):
            wrong.append(f"{path}: a picture of other figures")
    assert wrong == []


def test_an_old_block_and_an_old_picture_are_found(page_blocks, tmp_path):
    """The oracle is a page that was changed by hand."""
    path = ROOT / "docs" / "explanation" / "results.md"
    text = TEXTS[path]
    figure = re.search(r"<!-- begin robots -->.*?\| `rss6` \| ([\d.]+)", text, re.DOTALL)
    old = text[: figure.start(1)] + "9.99" + text[figure.end(1) :]
    assert page_blocks.renewed(path, old) == text
    code = tmp_path / "mine.py"
    code.write_text("new = 1\n", encoding="utf-8")
    page = "<!-- begin mine.py -->\nold\n<!-- end -->\n"
    assert "```python\nnew = 1\n```" in page_blocks.renewed(tmp_path / "page.md", page)
    assert page_blocks.drawn_from(tmp_path / "none.png") is None


def test_every_page_can_be_reached():
    """From the first one, by the tables of contents, whose names are hidden and have links beside
    them.
    """
    reached, waiting = set(), [ROOT / "docs" / "index.md"]
    while waiting:
        path = waiting.pop()
        reached.add(path)
        for block in re.findall(
            r"^```\{toctree\}\n(.*?)^```", TEXTS.get(path, ""), re.MULTILINE | re.DOTALL
        ):
            names = [
                line for line in block.split() if not line.startswith(":") and not line.isdecimal()
            ]
            found = [
                (path.parent / f"{name}.md").resolve()
                for name in names
                if not name.startswith("generated/")
            ]
            waiting += [one for one in found if one not in reached]
            links = re.findall(r"\]\(([\w/.]+)\.md\)", TEXTS[path])
            assert {name for name in names if not name.startswith("generated/")} <= set(links), path
    assert sorted(set(PAGES) - reached) == []


@pytest.mark.thorough
def test_it_is_built_without_a_warning(tmp_path):
    """Without running the examples, which `sh .ci/docs` does; on a copy, whose outputs are nobody
    else's.
    """
    pytest.importorskip("sphinx_gallery")
    for entry in ROOT.iterdir():
        if entry.is_file():  # pages may include it, with links from its own place
            shutil.copy(entry, tmp_path)
        elif entry.name not in ("docs", "build", ".venv", ".git"):
            (tmp_path / entry.name).symlink_to(entry)
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("generated"))
    ran = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-D", "plot_gallery=0", "docs", "html"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "html" / "reference" / "commands.html").exists()
