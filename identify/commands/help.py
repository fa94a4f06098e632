"""Help of the command line, with commands first and by group, and the exit statuses."""

from pathlib import Path
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

# Keys of a scenario outside of its sections, for which some would expect an option.
SCENARIO_KEYS = ("robot", "sensor", "renderer", "pose_method")

# Error of a wrong command line, which typer has under no public name.
UsageError: Any = typer.BadParameter.__base__

OTHERS = "Further commands"  # title of the commands that have no group of their own


class Command(TyperCommand):
    """Command whose help ends with the list of its possible exit statuses."""

    statuses: ClassVar[tuple[int, ...]] = (DONE, NOT_DONE, MISUSED, STOPPED)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments. An error names the form in which the command takes what was typed.

        Some commands have the option --out for a folder, and others have an argument.
        """
        typed = list(args)
        try:
            return super().parse_args(ctx, args)
        except UsageError as error:
            # Only the error of a missing option has its parameter, and an empty message.
            if not error.message and getattr(error, "param", None) is not None:
                error.message = self._missing(error.param.name, typed)
                raise
            said = self._remedy(getattr(error, "option_name", None) or "", error.message)
            if said:
                error.message += f"; {said}"
                error.possibilities = None
            raise

    def _missing(self, name: str, typed: list[str]) -> str:
        """Return the right form of a command that lacks --out for its folder, or nothing."""
        if name != "out" or any(one.param_type_name == "argument" for one in self.params):
            return ""
        folder = typed[0] if typed and not typed[0].startswith("-") else "FOLDER"
        # A file that a run has written stands for the folder of the run.
        if Path(folder).is_file():
            folder = str(Path(folder).parent)
        return f"A folder stands after --out: cmmsim {self.name} --out {folder}"

    def _remedy(self, option: str, message: str) -> str:
        """Return the right form of an unknown option or a superfluous argument, or nothing."""
        names = {name for one in self.params for name in (one.name, *one.opts)}
        key = option.lstrip("-").replace("-", "_")
        if option == "--out" and "run" in names:
            return f"the folder of the run stands alone: cmmsim {self.name} FOLDER"
        if key in SCENARIO_KEYS and "--set" in names:
            return f"it is a key of the scenario: --set {key}=VALUE"
        if "extra argument" in message and "--out" in names and "run" not in names:
            folder = message.rpartition("(")[2].rstrip(")").split()[0]
            return f"a folder stands after --out: cmmsim {self.name} --out {folder}"
        return ""

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
