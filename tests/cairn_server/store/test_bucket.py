"""A bucket that does not answer, or refuses one object: the one puts all calls to rest, the other fails alone."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import pytest
from obstore.exceptions import GenericError
from obstore.store import MemoryStore
from tests.fixtures.server.deadline import DEADLINE_S
from tests.fixtures.server.object_store import READER, ObjectPlace

from cairn_server.store.objects.bucket import LARGE_BYTES, REST_MAX_S, REST_S, Bucket, open_bucket
from cairn_server.store.objects.cold_bytes import MARK, AwayError

AWAY = "Generic S3 error: Error performing GET http://x in 2s, after 3 retries - HTTP error: error sending request"
BUSY = "Generic S3 error: Error performing GET http://x in 2s - Server returned non-2xx status code: 503 Slow Down:"
LATER = "Generic S3 error: Error performing GET http://x in 2s - Server returned non-2xx status code: 429 Too Many:"
REFUSED = "The operation lacked privileges: Server returned non-2xx status code: 403 Forbidden: <xml>"
PAST = "Generic S3 error: Server returned non-2xx status code: 416 Range Not Satisfiable: <xml>"


class FailingStore(MemoryStore):
    """A store that fails as a test says."""

    failure: str | None = None
    calls = 0
    meanwhile: Callable[[], object] = staticmethod(lambda: None)

    def get(self, *args: Any, **options: Any) -> Any:
        """Read, or fail."""
        self._call()
        return super().get(*args, **options)

    def get_range(self, *args: Any, **options: Any) -> Any:
        """Read, or fail."""
        self._call()
        return super().get_range(*args, **options)

    def _call(self) -> None:
        self.calls += 1
        self.meanwhile()
        if self.failure is not None:
            raise GenericError(self.failure)


@dataclass
class Sight:
    """A bucket over a store that fails, and its clock."""

    store: FailingStore = field(default_factory=FailingStore)
    now_s: float = 0.0

    def __post_init__(self) -> None:
        self.bucket = Bucket(self.store, steady_s=lambda: self.now_s)
        self.bucket.put("a", b"123")

    def fail(self) -> str:
        """Message of a read that fails."""
        with pytest.raises(AwayError) as caught:
            self.bucket.get("a")
        return caught.value.message


@pytest.mark.parametrize("failure", [AWAY, BUSY, LATER])
def test_after_a_failure_no_call_reaches_the_store_until_the_rest_is_over(failure: str) -> None:
    seen = Sight()
    seen.store.failure = failure
    assert failure[:60] in seen.fail()
    seen.store.failure = None
    assert "a moment ago" in seen.fail()
    assert seen.store.calls == 1
    seen.now_s += REST_S
    assert seen.bucket.get("a") == b"123"


def test_rests_double_up_to_a_bound_and_begin_again_after_an_answer() -> None:
    seen = Sight()
    seen.store.failure = AWAY
    for turn, rest_s in enumerate((REST_S, 2 * REST_S, 4 * REST_S, 8 * REST_S, REST_MAX_S, REST_MAX_S), start=1):
        seen.fail()
        seen.now_s += rest_s - 0.5
        seen.fail()
        assert seen.store.calls == turn
        seen.now_s += 0.5
    seen.store.failure = None
    seen.bucket.get("a")
    seen.store.failure = AWAY
    seen.fail()
    seen.store.failure = None
    seen.now_s += REST_S
    assert seen.bucket.get("a") == b"123"


def test_one_call_tries_a_store_that_failed_and_all_others_fail_at_once() -> None:
    seen = Sight()
    seen.store.failure = AWAY
    seen.fail()
    seen.now_s += 1e6
    begun, may_end = threading.Event(), threading.Event()

    def hang() -> None:
        begun.set()
        may_end.wait(DEADLINE_S)

    seen.store.meanwhile = hang
    with ThreadPoolExecutor(1) as pool:
        probe = pool.submit(seen.fail)
        begun.wait(DEADLINE_S)
        # However long the attempt takes.
        for _ in range(3):
            seen.now_s += 1e6
            assert "a moment ago" in seen.fail()
        may_end.set()
        assert AWAY[:60] in probe.result(DEADLINE_S)
    assert seen.store.calls == 2


def test_an_object_that_is_refused_fails_alone() -> None:
    seen = Sight()
    seen.store.failure = REFUSED
    assert "403" in seen.fail()
    seen.store.failure = None
    assert seen.bucket.get("a") == b"123"


def test_an_answer_that_refuses_ends_a_rest() -> None:
    seen = Sight()
    seen.store.failure = AWAY
    seen.fail()
    seen.now_s += REST_S
    seen.store.failure = REFUSED
    seen.fail()
    seen.store.failure = None
    assert seen.bucket.get("a") == b"123"


def test_an_object_that_ends_before_the_part_asked_for_is_as_good_as_lost() -> None:
    seen = Sight()
    seen.store.failure = PAST
    assert seen.bucket.part("a", start=9, size_bytes=1) is None
    seen.store.failure = None
    assert seen.bucket.get("a") == b"123"


def test_a_large_object_has_a_longer_time() -> None:
    small, large = MemoryStore(), MemoryStore()
    bucket = Bucket(small, large)
    bucket.put("a", bytes(LARGE_BYTES))
    bucket.put("b", bytes(LARGE_BYTES - 1))
    names = [[found["path"] for page in store.list() for found in page] for store in (small, large)]
    assert names == [["b"], ["a"]]


@pytest.mark.processes
@pytest.mark.slow
def test_a_real_store_refuses_and_cuts_single_objects(
    object_place: ObjectPlace, monkeypatch: pytest.MonkeyPatch
) -> None:
    bucket = object_place.bucket
    bucket.put(MARK, b"cairn")
    bucket.put("a", b"123")
    assert bucket.part("a", start=9, size_bytes=1) is None
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", READER)
    reader = open_bucket(object_place.url)
    with pytest.raises(AwayError, match="403"):
        reader.put("b", b"")
    assert reader.get("a") == b"123"
