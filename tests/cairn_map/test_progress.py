"""Progress on standard error: in place on a terminal, few lines in a log, no items lost."""

import io

import pytest

from cairn_map import progress
from cairn_map.progress import (
    CLEAR_LINE,
    PercentLine,
    StatusLine,
    counting,
    while_working,
    with_passing_progress,
    with_progress,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_items_come_through_in_their_order_with_a_bar_in_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(with_progress(iter("abc"), "letters", total=3)) == ["a", "b", "c"]
    shown = capsys.readouterr()
    assert shown.out == "" and "letters" in shown.err and "3/3" in shown.err


def test_a_passing_bar_and_a_spinner_write_nothing_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(with_passing_progress([1, 2], "images", total=2)) == [1, 2]
    with while_working("solving"):
        pass
    assert capsys.readouterr() == ("", "")


def test_a_passing_bar_is_a_line_now_and_then_in_a_log(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 6.0, 12.0, 18.0, 24.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    assert list(with_passing_progress("abcd", "images", total=4)) == ["a", "b", "c", "d"]
    assert capsys.readouterr().err == "images: 2 of 4, about 12 s left\n"


def test_a_line_is_replaced_on_a_terminal_and_kept_in_a_log() -> None:
    terminal, log = Terminal(), io.StringIO()
    for stream in (terminal, log):
        line = StatusLine(stream)
        line.show("a")
        line.show("b")
        line.clear()
    assert terminal.getvalue() == f"{CLEAR_LINE}a{CLEAR_LINE}b{CLEAR_LINE}"
    assert log.getvalue() == "a\nb\n"


def test_a_percentage_comes_at_once_on_a_terminal_and_not_before_seconds_in_a_log() -> None:
    terminal, log = Terminal(), io.StringIO()
    for stream in (terminal, log):
        percent = PercentLine("check", stream)
        percent.at(1, 3)
        percent.at(2, 3)
        percent.finish()
    assert terminal.getvalue() == f"{CLEAR_LINE}check: 33 %{CLEAR_LINE}"
    assert log.getvalue() == ""


def test_a_count_of_unknown_end_is_given_a_unit_at_a_time(capsys: pytest.CaptureFixture[str]) -> None:
    with counting("lab.bag", "messages") as one:
        for _ in range(3):
            one()
    assert "lab.bag: 3 messages" in capsys.readouterr().err
