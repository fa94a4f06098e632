"""Pages that are written from the code before each build, into docs/generated: the Python
interface, which Sphinx lays out. Commands and keys of files stand in the pages (`page_blocks.py`).
"""

import inspect
import re
from collections.abc import Callable
from pathlib import Path

import api_pages
from pydantic import BaseModel
from sphinx.application import Sphinx

PAGES: dict[str, Callable[[], str]] = {
    "api_cmmsim.md": lambda: api_pages.package("cmmsim"),
    "api_dynamics.md": lambda: api_pages.package("dynamics"),
    "api_identify.md": lambda: api_pages.package("identify"),
}

# Directives that only the build can read. A code host hides them, because they stand in a comment.
FOR_THE_BUILD = re.compile(r"^<!-- for the build\n(.*?)^-->$", re.MULTILINE | re.DOTALL)


def with_directives(app: Sphinx, name: str, source: list[str]) -> None:
    """Take the directives of a page out of their comments."""
    source[0] = FOR_THE_BUILD.sub(r"\1", source[0])


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
    app.connect("source-read", with_directives)
    app.connect("autodoc-process-signature", without_fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
