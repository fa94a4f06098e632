"""The command ``cmmsim`` called in this process, and what it may say."""

import sys

import pytest
from typer.main import get_command

from identify.__main__ import main
from identify.commands.app import app


def command(*arguments):
    """Exit status of the command in this process."""
    old, sys.argv = sys.argv, ["cmmsim", *map(str, arguments)]
    try:
        main()
    except SystemExit as exit_:
        return exit_.code or 0
    finally:
        sys.argv = old
    return 0


def one_line(text):
    """The text, which must be one error line."""
    assert text.startswith("error: ")
    assert text.count("\n") == 1, text
    return text


def refusal(error, action, *arguments):
    """The one line with which such an error refuses an action."""
    with pytest.raises(error) as caught:
        action(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def leaves(group=None, words=()):
    """Every command, as the words that call it; those of a group, or of all."""
    for name, one in (group or get_command(app)).commands.items():
        if hasattr(one, "commands"):
            yield from leaves(one, (*words, name))
        else:
            yield (*words, name)
