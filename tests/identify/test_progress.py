import io

import pytest
from rich.console import Console

from identify.files.atomic import atomic_path, write_text
from identify.progress import RichProgress, SilentProgress, terminal_progress


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


def test_file_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / "folder" / "a.txt"
    write_text(path, "old")

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            assert path.read_text() == "old"
            assert temporary.suffix == ".txt"
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_file_has_the_usual_rights(tmp_path):
    write_text(tmp_path / "a.txt", "x")
    (tmp_path / "b.txt").write_text("x")
    assert (tmp_path / "a.txt").stat().st_mode == (tmp_path / "b.txt").stat().st_mode
