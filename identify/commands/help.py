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
# Meaning of every exit status, the same in all commands.
STATUSES = {
    DONE: "The command succeeded.",
    NOT_DONE: "The command failed; one line on standard error says why.",
    MISUSED: "The command line is wrong: no such command or option, or a value that is not "
    "allowed.",
    ROWS_FAILED: "The study has finished, but some rows failed; their errors are in the table.",
    BEYOND_LIMIT: "The command has finished, but a result is beyond its limit; one line on "
    "standard error names it.",
    STOPPED: "Ctrl-C stopped the command.",
}

OTHERS = "Further commands"  # title of the commands that have no group of their own


class Command(TyperCommand):
    """Command whose help ends with the list of its possible exit statuses."""

    statuses: ClassVar[tuple[int, ...]] = (DONE, NOT_DONE, MISUSED, STOPPED)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the exit statuses."""
        with formatter.section("Exit status"):
            formatter.write_dl([(str(status), STATUSES[status]) for status in self.statuses])


class Judging(Command):
    """Command that compares something with a limit."""

    statuses: ClassVar[tuple[int, ...]] = (DONE, NOT_DONE, MISUSED, BEYOND_LIMIT, STOPPED)


class RowsCommand(Command):
    """Command whose rows can fail."""

    statuses: ClassVar[tuple[int, ...]] = (DONE, NOT_DONE, MISUSED, ROWS_FAILED, STOPPED)


class StudyCommand(Command):
    """Command of studies. Rows can fail, and the expected laws are limits."""

    statuses: ClassVar[tuple[int, ...]] = tuple(STATUSES)


class Commands(TyperGroup):
    """Group of commands. Its help lists the commands before the options.

    If Ctrl-C stops a command, "aborted" is printed, because typer would print nothing.
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
        """Write the commands group by group, each with the first paragraph of its help."""
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
        """Write only the options, because the commands have been written before."""
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
