"""Subcommands of ``cmmsim``. Heavy imports are late: ``--help`` must not wait for CasADi and OpenGL."""

from typing import Any

import typer


def new_folder(default: str) -> Any:
    """The option of a folder to write into; default: how the help calls the one that is taken where it is left out."""
    return typer.Option("--out", help="Output folder, new or empty.", show_default=default)


def repeatable(what: str, default: str) -> Any:
    """An option that may be given several times; default: how the help calls what holds without it."""
    return typer.Option(help=f"{what}; repeatable.", show_default=default)
