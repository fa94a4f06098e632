"""Every tutorial can be followed: its files, commands and code, in order, in an empty folder."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
TUTORIALS = ROOT / "docs" / "tutorials"
COMMANDS = ",".join(["time_s", *(f"command_joint{leg}_rad" for leg in range(1, 7))])
# What the page before left in the folder, or what the reader has: commands of a robot.
AFTER = {
    "own_record": "cmmsim run quick",
    "real_photographs": f"(echo {COMMANDS}; seq 0 23 | awk '{{print $1 / 60 \",0,0,0,0,0,0\"}}') "
    ">commands.csv",
}

# Lines that make the environment in which this test runs.
SETTING_UP = ("sh .ci/setup", ". .venv/bin/activate")

# What the code of a page takes from its reader, as the page says: arrays of a camera's driver.
GIVEN = {
    "real_photographs": """
import cv2
from pathlib import Path

lefts, rights = (
    [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(Path(f"photos/{side}").glob("*"))]
    for side in ("left", "right")
)
"""
}


class Step(NamedTuple):
    """A file to save, a block of a shell, or Python code."""

    kind: str
    text: str


def steps_of(page):
    """The steps of a page in their order."""
    found = [Step("sh", AFTER[page])] if page in AFTER else []
    text = (TUTORIALS / f"{page}.md").read_text(encoding="utf-8")
    blocks = (
        r"(?:as `([\w.]+)`:\n\n|<!-- begin (\S+) -->\n\n)?^```(\S+)\n(.*?)^```$"  # with its name
    )
    for saved_as, file, language, body in re.findall(blocks, text, re.MULTILINE | re.DOTALL):
        if language == "toml" and saved_as:
            found.append(Step("sh", f"cat >{saved_as} <<'END'\n{body}END"))
        elif file:
            found.append(Step("file", file))
        elif language == "sh":
            lines = [line for line in body.splitlines() if line not in SETTING_UP]
            found.append(Step("sh", "\n".join(lines)))
        elif language == "python":
            found.append(Step("python", GIVEN.get(page, "") + body))
    return found


PAGES = sorted(path.stem for path in TUTORIALS.glob("*.md") if path.stem != "index")


def test_every_tutorial_has_steps_and_every_script_that_it_shows_is_run():
    for page in PAGES:
        steps = steps_of(page)
        assert [step for step in steps if step.kind != "file"], page
        text = (TUTORIALS / f"{page}.md").read_text(encoding="utf-8")
        for step in steps:
            if step.kind == "file" and step.text.endswith(".py"):
                name = Path(step.text).stem
                assert re.search(rf"(python|pytest|--plugin) {name}\b", text), (page, step.text)


@pytest.mark.thorough
@pytest.mark.parametrize("page", PAGES)
def test_a_tutorial_runs_from_its_first_line_to_its_last(page, tmp_path):
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "MPLBACKEND": "Agg",
    }
    for name in [name for name in environment if name.startswith("PYTEST_")]:
        del environment[name]
    text = (TUTORIALS / f"{page}.md").read_text(encoding="utf-8")
    done = []
    for step in steps_of(page):
        if step.kind == "file":
            shutil.copy(TUTORIALS / step.text, tmp_path)
            name = Path(step.text).name
            in_a_sentence = f"`python {name}`" in text
            if not in_a_sentence:
                continue
            step = Step("sh", f"python {name}")
        shell = ["bash", "-euo", "pipefail", "-c"] if step.kind == "sh" else [sys.executable, "-c"]
        ended = subprocess.run(
            [*shell, step.text],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        # a line that exports a variable holds for the rest of the page
        exported = re.findall(r"^export (\w+)=(.+)$", step.text, re.MULTILINE)
        for name, value in exported:
            environment[name] = value.replace("$PWD", str(tmp_path)) + os.pathsep + str(ROOT)
        assert ended.returncode == 0, f"{step.text}\n{ended.stdout[-3000:]}\n{ended.stderr[-3000:]}"
        assert "Traceback" not in ended.stderr
        done.append(step)
    assert done
