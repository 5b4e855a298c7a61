"""Slices of computing: never more at once than places, none waits for ever, and a short one not for a long one."""

import threading
from collections.abc import Iterable, Iterator
from typing import TypeVar

import pytest
from tests.fixtures.server.deadline import until

from cairn_server.sync.slices import SLICE_S, Slices

T = TypeVar("T")


def taken(slices: Slices, parts: Iterable[T]) -> Iterator[T]:
    """All parts, in slices of one turn."""
    with slices.turn():
        yield from slices.of(parts)


def test_all_parts_come_in_order_and_no_more_are_made_at_once_than_places() -> None:
    slices, lock = Slices(2, steady_s=Ticking()), threading.Lock()
    at_work, most = 0, 0

    def parts() -> Iterator[int]:
        nonlocal at_work, most
        for n in range(50):
            with lock:
                at_work += 1
                most = max(most, at_work)
            with lock:
                at_work -= 1
            yield n

    made: list[list[int]] = []
    threads = [threading.Thread(target=lambda: made.append(list(taken(slices, parts())))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [list(range(50))] * 8
    assert 1 <= most <= 2 and slices.waiting == 0


def test_a_short_reply_is_done_in_the_midst_of_a_long_one() -> None:
    slices, ticking = Slices(1, steady_s=Ticking()), threading.Event()
    order: list[str] = []

    def long() -> Iterator[str]:
        yield "long begins"
        ticking.set()
        until(lambda: slices.waiting == 1, "the short one waits")
        yield "a slice later"
        yield "long ends"

    thread = threading.Thread(target=lambda: order.extend(taken(slices, long())))
    thread.start()
    ticking.wait()
    order += taken(slices, ["short"])
    thread.join()
    assert order == ["long begins", "a slice later", "short", "long ends"]


def test_an_error_gives_the_slice_back() -> None:
    slices = Slices(1)

    def failing() -> Iterator[int]:
        yield 1
        raise ValueError("damaged")

    with pytest.raises(ValueError, match="damaged"):
        list(taken(slices, failing()))
    assert list(taken(slices, [2])) == [2]


class Ticking:
    """A clock on which every look is a slice later."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def __call__(self) -> float:
        self._now_s += SLICE_S
        return self._now_s
