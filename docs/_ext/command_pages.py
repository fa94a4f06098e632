"""The command line, from its own help: what ``cmmsim COMMAND --help`` says, with a heading and a
table of options.
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from identify.commands.app import app
from identify.commands.help import STATUSES

VALUES = {Path: "PATH", int: "N", float: "NUMBER"}
"""What stands for an option's value, by its type, where the option does not say."""


def commands() -> str:
    """All commands in Markdown, by the groups of ``cmmsim --help``, each with a heading of its
    own."""
    root = typer.main.get_command(app)
    parts = [_help(root.help), _help(getattr(root, "epilog", None)), _statuses(STATUSES)]
    panel = None
    for words, command, group in _all(root, ("cmmsim",)):
        if group != panel:
            panel = group
            parts.append(f"## {group}")
        parts += [
            f"### {' '.join(words)}",
            _usage(words, command),
            _help(command.help),
            _parameters(command),
        ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _statuses(meanings: dict[int, str]) -> str:
    rows = "\n".join(f"| {status} | {meaning} |" for status, meaning in sorted(meanings.items()))
    return (
        "Every command ends with one of these exit statuses:\n\n| status | meaning |\n| --- | "
        f"--- |\n{rows}"
    )


def _all(
    group: Any, words: tuple[str, ...], panel: str = ""
) -> Iterator[tuple[tuple[str, ...], Any, str]]:
    """Name in words, command and group of each, in their order."""
    for name, command in group.commands.items():
        inner = panel or getattr(command, "rich_help_panel", None) or "Commands"
        if getattr(command, "hidden", False):
            continue
        if hasattr(command, "commands"):
            yield from _all(command, (*words, name), inner)
        else:
            yield (*words, name), command, inner


def _usage(words: tuple[str, ...], command: Any) -> str:
    pieces = [_metavar(one) for one in command.params if one.param_type_name == "argument"]
    return f"```text\n{' '.join([*words, *pieces, '[OPTIONS]'])}\n```"


def _metavar(argument: Any) -> str:
    name = (argument.metavar or argument.name).upper()
    name = f"{name}..." if argument.nargs == -1 else name
    return name if argument.required else f"[{name}]"


def _help(text: str | None) -> str:
    """Paragraphs as Markdown; those that are set as they stand (behind a backspace) as text
    blocks."""
    parts = []
    for paragraph in inspect.cleandoc(text or "").split("\n\n"):
        if not paragraph:
            continue
        if paragraph.startswith("\b") or "\n  " in paragraph:
            lines = paragraph.lstrip("\b\n").split("\n")
            if len(lines) > 1 and lines[0].endswith(":"):
                parts.append(lines.pop(0))
            parts.append(
                "\n".join(
                    ["```text", *inspect.cleandoc("\n".join(["", *lines])).split("\n"), "```"]
                )
            )
        else:
            parts.append(_escaped(paragraph))
    return "\n\n".join(parts)


def _parameters(command: Any) -> str:
    rows = []
    for one in command.params:
        argument = one.param_type_name == "argument"
        name = (
            (one.metavar or one.name).upper()
            if argument
            else ", ".join([*one.opts, *one.secondary_opts])
        )
        if not argument and not getattr(one, "is_flag", False):
            name += f" {one.metavar or VALUES.get(one.type_descriptor.annotation, 'TEXT')}"
        default = getattr(one, "show_default", None)
        if not isinstance(default, str):
            value = one.default
            default = (
                ""
                if value is None or value is False or callable(value) or one.required
                else str(value)
            )
        said = _escaped(getattr(one, "help", "") or "")
        shown = name.replace("|", "\\|")
        rows.append(
            f"| `{shown}` | {said} | {_escaped(default) or ('required' if one.required else '')} |"
        )
    return "\n".join(["| name | what | default |", "| --- | --- | --- |", *rows]) if rows else ""


def _escaped(text: str) -> str:
    """One paragraph of plain text in Markdown."""
    for sign in "\\<>*_`|[]{}$":
        text = text.replace(sign, f"\\{sign}")
    return " ".join(text.split())
