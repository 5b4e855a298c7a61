"""A bucket of an S3-compatible object store, or a folder of it; nothing here depends on conditional writes.

Credentials and endpoint come from the usual variables of the environment: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY,
AWS_REGION, and for stores other than Amazon's AWS_ENDPOINT_URL.

A store that does not answer must not hold up what does not need it: after a failure all calls fail at once for a rest,
then one of them tries again, and all others go on failing at once until it has an answer. A refusal of one object (403,
416) is an answer: it begins no rest.
"""

import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from typing import TYPE_CHECKING

from obstore.exceptions import BaseError
from obstore.store import MemoryStore, S3Store, from_url

from cairn_server.store.objects.cold_bytes import MARK, AwayError

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

REST_S, REST_MAX_S = 2.0, 30.0
"""Time for which no call is tried after a failure, doubled by each attempt that fails, and the longest."""
CONNECT_S, TIMEOUT_S, TRIES_S = 2, 10, 4
"""Longest time for a connection, for one request with its answer, and in which a failed request is tried again."""
LARGE_BYTES, LARGE_TIMEOUT_S = 2 << 20, 140
"""Size from which on a request may take longer, and for how long: 64 MB at 0.5 MB/s."""
WORKERS = 16
"""Most objects written or deleted at the same time."""
PAGE = 1000
"""Names that are listed at once."""
RETRIES: "RetryConfig" = {
    "max_retries": 3,
    "retry_timeout": timedelta(seconds=TRIES_S),
    "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=1), "base": 2},
}
REFUSAL = re.compile(r"status code: 4(?!08|29)\d\d\b")
"""Refusal of one request in an error's first line, by a store that answers (408 and 429: it cannot keep up)."""
SHORTER = re.compile(r"status code: 416\b")
"""Answer to a part of an object that begins after its end."""


class Bucket:
    """Objects under one prefix; usable from any thread."""

    def __init__(
        self,
        store: S3Store | MemoryStore,
        for_large: S3Store | MemoryStore | None = None,
        *,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Use a store of obstore's, and the same with a longer time for a request of `LARGE_BYTES`."""
        self._store = store
        self._steady_s = steady_s
        self._for_large = for_large or store
        self._lock = threading.Lock()
        self._rest_s = 0.0
        """Length of the rest that began last; 0: the store answers."""
        self._rests_until_s = 0.0
        self._is_probed = False
        """True while one call tries a store that failed."""
        self.failures = 0
        """Count of the calls that the store did not answer."""

    def get(self, name: str) -> bytes | None:
        """An object's bytes; None: there is no such object.

        Raises:
            AwayError: the store does not answer, or refuses.
        """
        with self._answers(f"read {name}"):
            try:
                return bytes(self._store.get(name).bytes())
            except FileNotFoundError:
                self._check_mark(name)
                return None

    def part(self, name: str, *, start: int, size_bytes: int) -> bytes | None:
        """Bytes of an object from `start` on; None: there is no such object, or it is shorter.

        Raises:
            AwayError: the store does not answer, or refuses.
        """
        if not size_bytes:
            return b""
        with self._answers(f"read {name}"):
            try:
                data = bytes(self._store_for(size_bytes).get_range(name, start=start, length=size_bytes))
            except FileNotFoundError:
                self._check_mark(name)
                return None
            except BaseError as exc:
                if SHORTER.search(_cause(exc)):
                    return None
                raise
        return data if len(data) == size_bytes else None

    def put(self, name: str, data: bytes) -> None:
        """Write an object.

        Raises:
            AwayError: the store does not take it.
        """
        with self._answers(f"write {name}"):
            self._store_for(len(data)).put(name, data, use_multipart=False)

    def put_all(self, objects: Sequence[tuple[str, bytes]]) -> None:
        """Write some objects, several at a time.

        Raises:
            AwayError: the store does not take one of them; others may be there.
        """
        _run_together([partial(self.put, name, data) for name, data in objects])

    def delete(self, name: str) -> None:
        """Delete an object, if it is there.

        Raises:
            AwayError: the store does not do so.
        """
        with self._answers(f"delete {name}"):
            try:
                self._store.delete(name)
            except FileNotFoundError:
                return

    def delete_all(self, names: Sequence[str]) -> None:
        """Delete some objects, several at a time: one by one, as not all stores take a list.

        Raises:
            AwayError: the store does not delete one of them; others may be gone.
        """
        _run_together([partial(self.delete, name) for name in names])

    def names(self, prefix: str) -> Iterator[list[str]]:
        """Names of all objects whose names begin so, some at a time.

        Raises:
            AwayError: the store does not answer.
        """
        pages = iter(self._store.list(prefix, chunk_size=PAGE))
        while True:
            with self._answers(f"list {prefix}"):
                page = next(pages, None)
            if page is None:
                return
            yield [found["path"] for found in page]

    def _store_for(self, size_bytes: int) -> S3Store | MemoryStore:
        return self._store if size_bytes < LARGE_BYTES else self._for_large

    def _check_mark(self, name: str) -> None:
        """Refuse to call an object lost in a bucket that lost its mark, too: it may be a wrong or an empty one.

        Raises:
            FileNotFoundError: there is no mark either.
        """
        if name != MARK:
            self._store.head(MARK)

    @contextmanager
    def _answers(self, what: str) -> Iterator[None]:
        is_probe = self._begin(what)
        try:
            yield
        except (BaseError, OSError) as exc:
            cause = _cause(exc)
            if isinstance(exc, FileNotFoundError) or REFUSAL.search(cause):
                self._wake(is_probe=is_probe)
            else:
                self._rest(is_probe=is_probe)
            raise AwayError(f"cannot {what}: {cause}") from exc
        else:
            self._wake(is_probe=is_probe)
        finally:
            if is_probe:
                self._is_probed = False

    def _begin(self, what: str) -> bool:
        """Begin a call; True if it is the one that tries a store that failed.

        Raises:
            AwayError: the store rests.
        """
        with self._lock:
            if not self._rest_s:
                return False
            if self._is_probed or self._steady_s() < self._rests_until_s:
                raise AwayError(f"cannot {what}: the object store did not answer a moment ago")
            self._is_probed = True
            return True

    def _rest(self, *, is_probe: bool) -> None:
        with self._lock:
            self.failures += 1
            # Of calls that were under way together the first begins the rest, and only an attempt makes it longer.
            if is_probe or not self._rest_s:
                self._rest_s = min(2 * self._rest_s, REST_MAX_S) or REST_S
                self._rests_until_s = self._steady_s() + self._rest_s

    def _wake(self, *, is_probe: bool) -> None:
        with self._lock:
            if is_probe:
                self._rest_s = 0.0


def open_bucket(url: str) -> Bucket:
    """The bucket of a URL, s3://BUCKET/PREFIX; nothing is asked of it yet.

    Raises:
        AwayError: the URL or the environment does not fit.
    """
    try:
        stores = [
            from_url(url, client_options=_client(timeout_s), retry_config=RETRIES)
            for timeout_s in (TIMEOUT_S, LARGE_TIMEOUT_S)
        ]
    except (BaseError, ValueError, TypeError) as exc:
        raise AwayError(_cause(exc)) from exc
    store, for_large = stores
    if not isinstance(store, S3Store) or not isinstance(for_large, S3Store):
        raise AwayError("only s3://BUCKET/PREFIX is known")
    return Bucket(store, for_large)


def _client(timeout_s: int) -> "ClientConfig":
    return {
        "connect_timeout": timedelta(seconds=CONNECT_S),
        "timeout": timedelta(seconds=timeout_s),
        "allow_http": True,  # if AWS_ENDPOINT_URL says so
    }


def _run_together(jobs: Sequence[Callable[[], None]]) -> None:
    """Run jobs, several at a time, all of them to their ends; the first failure is raised."""
    if len(jobs) == 1:
        jobs[0]()
        return
    with ThreadPoolExecutor(min(WORKERS, len(jobs) or 1), "cairn-objects") as pool:
        for done in [pool.submit(job) for job in jobs]:
            done.result()


def _cause(exc: Exception) -> str:
    """First line of an error of obstore's, whose others are for its developers."""
    return str(exc).strip().partition("\n")[0][:300] or type(exc).__name__
