"""Pages that are written from the code before each build, into docs/generated."""

import inspect
from collections.abc import Callable
from pathlib import Path

import api_pages
import command_pages
import settings_pages
from pydantic import BaseModel
from sphinx.application import Sphinx

PAGES: dict[str, Callable[[], str]] = {
    "commands.md": command_pages.commands,
    "scenario.md": settings_pages.scenario,
    "sensor.md": settings_pages.sensor,
    "robot.md": settings_pages.robot,
    "study.md": settings_pages.study,
    "record.md": settings_pages.record,
    "record_rules.md": settings_pages.record_rules,
    "record_variables.md": settings_pages.record_variables,
    "api_cmmsim.md": lambda: api_pages.package("cmmsim"),
    "api_dynamics.md": lambda: api_pages.package("dynamics"),
    "api_identify.md": lambda: api_pages.package("identify"),
}


def write_pages(app: Sphinx) -> None:
    """Write what has changed, so that an unchanged page is not read again."""
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        path = folder / name
        text = page()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def without_fields(
    app: Sphinx, what: str, name: str, found: object, options: object, signature: str, returned: str
) -> tuple[str, str] | None:
    """The signature of settings is their file's page: here it would fill a screen."""
    if inspect.isclass(found) and issubclass(found, BaseModel):
        return "", ""
    return None


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages when the build begins; they are included by others, and are no documents of
    their own.
    """
    app.connect("builder-inited", write_pages, priority=100)
    app.connect("autodoc-process-signature", without_fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
