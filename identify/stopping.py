"""Ctrl-C ends a command that keeps what it has done in one line, at whatever moment it comes."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

import typer

from identify.interrupts import STOPPED, noted

P = ParamSpec("P")


def stoppable(command: Callable[P, None]) -> Callable[P, None]:
    """The command, which says in one line that Ctrl-C stopped it where it does not say so itself."""

    @wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        with noted() as interrupt:
            try:
                command(*arguments, **options)
            except typer.Exit:
                raise
            except (KeyboardInterrupt, Exception) as error:
                if isinstance(error, Exception) and not interrupt.came:
                    raise
                typer.echo("stopped: what is done is kept; the same command goes on from there", err=True)
                raise typer.Exit(STOPPED) from None

    return run
