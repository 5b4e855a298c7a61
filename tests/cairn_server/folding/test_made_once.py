"""Single-flight cache: concurrent requests for one key compute its value once, and values are kept within a bound."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from cairn_server.folding.single_flight import IDLE_S, MadeOnce

ASKERS = 8


def kept(limit_bytes: int = 100) -> MadeOnce[str, bytes]:
    return MadeOnce(limit_bytes=limit_bytes, size_of=len)


def refuse() -> bytes:
    raise AssertionError("made again")


def test_all_who_ask_meanwhile_get_what_the_first_one_makes() -> None:
    values, made, go = kept(), [0], threading.Event()

    def make() -> bytes:
        made[0] += 1
        assert go.wait(60.0)
        return b"value"

    with ThreadPoolExecutor(ASKERS) as pool:
        asked = [pool.submit(values.get, "name", make) for _ in range(ASKERS)]
        assert values.get("other", lambda: b"x") == b"x"  # no request waits for a value that it did not ask for for
        go.set()
        assert [future.result() for future in asked] == [b"value"] * ASKERS
    assert made == [1]
    assert values.get("name", refuse) == b"value"


def test_a_failure_goes_to_all_who_wait_and_is_not_kept() -> None:
    values, go = kept(), threading.Event()

    def fail() -> bytes:
        assert go.wait(60.0)
        raise ZeroDivisionError

    with ThreadPoolExecutor(ASKERS) as pool:
        asked = [pool.submit(values.get, "name", fail) for _ in range(ASKERS)]
        go.set()
        assert all(isinstance(future.exception(), ZeroDivisionError) for future in asked)
    assert values.get("name", lambda: b"value") == b"value"


def test_what_nobody_asked_for_longest_is_forgotten_first() -> None:
    values = kept(limit_bytes=2)
    for name in ("a", "b", "a", "c"):
        values.get(name, name.encode)
    assert [values.get(name, refuse) for name in ("a", "c")] == [b"a", b"c"]
    with pytest.raises(AssertionError, match="made again"):
        values.get("b", refuse)


def test_what_is_larger_than_the_bound_is_handed_out_but_not_kept() -> None:
    values = kept(limit_bytes=2)
    assert values.get("a", lambda: b"long") == b"long"
    assert values.get("a", lambda: b"else") == b"else"


def test_what_nobody_asked_for_of_late_goes_when_something_else_is_made() -> None:
    now_s = [0.0]
    values: MadeOnce[str, bytes] = MadeOnce(limit_bytes=100, size_of=len, steady_s=lambda: now_s[0])
    for name in ("old", "asked for"):
        values.get(name, lambda: b"value")
    now_s[0] = IDLE_S * 0.9
    values.get("asked for", refuse)
    now_s[0] = IDLE_S * 1.1
    values.get("new", lambda: b"value")
    assert values.get("asked for", refuse) == b"value"
    assert values.get("old", lambda: b"again") == b"again"
    assert values._size_bytes == 3 * len(b"value")
