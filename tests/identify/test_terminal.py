"""What a user sees at the terminal: progress, and tables as they were given."""

import io

import pytest
from rich.console import Console

from identify.progress import RichProgress, print_table, terminal_progress

HEADER = ("parameter", "std [um]", "remark")
ROWS = [("joint1.coulomb", "0.12", "fixed"), ("lp [a]", "-1234.5", "from the [red]prior[/red] :smile:")]


def shown(terminal, fail=False, rate=""):
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, width=100)
    try:
        with RichProgress(console, rate).stage("record", 4) as advance:
            advance()
            advance(n=2)
            if fail:
                raise RuntimeError("camera unplugged")
    except RuntimeError:
        pass
    return stream.getvalue()


def test_a_terminal_shows_a_bar_and_a_file_one_plain_line_a_stage_that_did_not_fail():
    bar, line = shown(terminal=True), shown(terminal=False)
    assert "3/4" in bar
    assert "left" in bar
    assert line.startswith("record: 3 of 4 in ")
    assert line.count("\n") == 1
    assert "\x1b" not in line
    assert shown(terminal=False, fail=True) == ""
    assert [" rows/s" in shown(terminal, rate="rows/s") for terminal in (True, False)] == [True, True]
    assert "/s" not in bar + line


@pytest.mark.parametrize(("quiet", "said"), [(True, ""), (False, "rows/s")])
def test_a_quiet_command_shows_nothing_and_another_its_rate(capfd, quiet, said):
    with terminal_progress(quiet, rate="rows/s").stage("record", 4) as advance:
        advance()
        advance(n=2)
    out, err = capfd.readouterr()
    assert out == ""
    assert said in err
    assert bool(err) is not quiet


def test_words_stand_left_numbers_right_brackets_stay_and_the_first_column_is_never_broken(capsys):
    print_table(HEADER, ROWS, ("parameter", "remark"), "of [x]", "std of [y]")
    title, header, rule, first, second, note = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert (title.strip(), note.strip(), set(rule)) == ("of [x]", "std of [y]", {"─"})
    assert header == "parameter      std [um] remark"
    assert first == "joint1.coulomb     0.12 fixed"
    assert second == "lp [a]          -1234.5 from the [red]prior[/red] :smile:"
    print_table(("study", "what it asks"), [("n" * 30, "how long " * 20)], ("study", "what it asks"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("n" * 30 + " how long")
    assert max(map(len, lines)) <= 80
    assert len(lines) > 5
