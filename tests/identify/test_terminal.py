"""What a user sees at the terminal: progress, and tables as they were given."""

import io

import pytest
from rich.console import Console

from identify.progress import RichProgress, SilentProgress, print_table, terminal_progress

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


def test_terminal_shows_a_bar_with_counts_and_time_left():
    assert "3/4" in shown(terminal=True)
    assert "left" in shown(terminal=True)


def test_elsewhere_one_plain_line_a_stage():
    text = shown(terminal=False)
    assert text.startswith("record: 3 of 4 in ")
    assert text.count("\n") == 1
    assert "\x1b" not in text


@pytest.mark.parametrize("terminal", [True, False])
def test_rate_is_shown_where_asked_for(terminal):
    assert " rows/s" in shown(terminal, rate="rows/s")
    assert "/s" not in shown(terminal)


def test_failed_stage_claims_nothing():
    assert shown(terminal=False, fail=True) == ""


def test_silent_progress_takes_the_same_calls(capfd):
    with SilentProgress().stage("record", 4) as advance:
        advance()
        advance(n=2)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("quiet", "said"), [(True, ""), (False, "rows/s")])
def test_a_quiet_command_shows_nothing_and_another_its_rate(capfd, quiet, said):
    with terminal_progress(quiet, rate="rows/s").stage("record", 4) as advance:
        advance()
    out, err = capfd.readouterr()
    assert out == ""
    assert said in err
    assert bool(err) is not quiet


def test_words_stand_left_numbers_right_and_brackets_stay(capsys):
    print_table(HEADER, ROWS, ("parameter", "remark"), "of [x]", "std of [y]")
    title, header, rule, first, second, note = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert (title.strip(), note.strip(), set(rule)) == ("of [x]", "std of [y]", {"─"})
    assert header == "parameter      std [um] remark"
    assert first == "joint1.coulomb     0.12 fixed"
    assert second == "lp [a]          -1234.5 from the [red]prior[/red] :smile:"


def test_the_first_column_is_never_broken(capsys):
    print_table(("study", "what it asks"), [("n" * 30, "how long " * 20)], ("study", "what it asks"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("n" * 30 + " how long")
    assert max(map(len, lines)) <= 80
    assert len(lines) > 5
