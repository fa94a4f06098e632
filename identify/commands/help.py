"""Help of the command line, with commands first and by group, and the exit statuses."""

from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

from identify.runtime import STOPPED

DONE = 0
NOT_DONE = 1
MISUSED = 2
ROWS_FAILED = 3
BEYOND_LIMIT = 4
STATUSES = {
    DONE: "It is done.",
    NOT_DONE: "It cannot be done; one line on standard error says why.",
    MISUSED: "The command line is wrong: no such command or option, or a value that it cannot "
    "have.",
    ROWS_FAILED: "The study is done, but some of its rows failed, and say why.",
    BEYOND_LIMIT: "It is done, and what it judges is beyond its limit, which one line names.",
    STOPPED: "Ctrl-C has ended it.",
}
"""Meaning of every exit status, the same in all commands."""

OTHERS = "Further commands"
"""Group of the commands that name none."""


class Command(TyperCommand):
    """Command whose help ends with the exit statuses that it may have."""

    statuses: ClassVar[tuple[int, ...]] = (DONE, NOT_DONE, MISUSED, STOPPED)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the exit statuses."""
        with formatter.section("Exit status"):
            formatter.write_dl([(str(status), STATUSES[status]) for status in self.statuses])


class Judging(Command):
    """Command that compares something with a limit."""

    statuses: ClassVar[tuple[int, ...]] = (DONE, NOT_DONE, MISUSED, BEYOND_LIMIT, STOPPED)


class StudyCommand(Command):
    """Command of studies, whose rows may fail and whose laws are limits."""

    statuses: ClassVar[tuple[int, ...]] = tuple(STATUSES)


class Commands(TyperGroup):
    """Group of commands, which help lists before its options.

    It also reports that Ctrl-C has ended a command, where typer alone would print nothing.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("aborted", err=True)
            raise typer.Exit(STOPPED) from None

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the purpose of the group, its commands, examples, and the options."""
        self.format_usage(ctx, formatter)
        self.format_help_text(ctx, formatter)
        self.format_commands(ctx, formatter)
        self.format_epilog(ctx, formatter)
        self.format_options(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands by their groups, each with the whole first paragraph of its help."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                sentence = " ".join((command.help or "").strip().split("\n\n")[0].split())
                groups.setdefault(getattr(command, "rich_help_panel", None) or OTHERS, []).append(
                    (name, sentence)
                )
        widest = max((len(name) for rows in groups.values() for name, _ in rows), default=0)
        # The sort is stable: groups stay in their order, and commands without one come last.
        for group, rows in sorted(groups.items(), key=lambda one: one[0] == OTHERS):
            with formatter.section(group if len(groups) > 1 else "Commands"):
                formatter.write_dl([(name.ljust(widest), sentence) for name, sentence in rows])

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options alone, because the commands stand before them."""
        options = [
            record
            for one in self.get_params(ctx)
            if (record := one.get_help_record(ctx)) is not None
        ]
        with formatter.section("Options"):
            formatter.write_dl(options)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples unchanged."""
        if self.epilog:
            formatter.write_paragraph()
            formatter.write(self.epilog.strip("\n") + "\n")
