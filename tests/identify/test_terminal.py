"""Tables at the terminal show what they were given."""

from identify.progress import print_table

HEADER = ("parameter", "std [um]", "remark")
ROWS = [("joint1.coulomb", "0.12", "fixed"), ("lp [a]", "-1234.5", "from the [red]prior[/red] :smile:")]


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
