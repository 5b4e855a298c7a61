"""A bucket of an S3-compatible object store, or a folder of it; nothing here depends on conditional writes.

Credentials and endpoint come from the usual variables of the environment: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY,
AWS_REGION, and for stores other than Amazon's AWS_ENDPOINT_URL.

A store that does not answer must not hold up what does not need it: after one failure all calls fail at once for
`REST_S`, then one of them tries again.
"""

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

from obstore.exceptions import BaseError
from obstore.store import MemoryStore, S3Store, from_url

from cairn_server.store.objects.cold_bytes import MARK, AwayError

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

REST_S = 2.0
"""Time for which no call is tried after a failure."""
CONNECT_S, TIMEOUT_S, TRIES_S = 2, 10, 4
"""Longest time for a connection, for one request with its answer, and in which a failed request is tried again."""
WRITERS = 8
"""Most objects written at the same time."""
PAGE = 1000
"""Names that are listed at once."""
CLIENT: "ClientConfig" = {
    "connect_timeout": timedelta(seconds=CONNECT_S),
    "timeout": timedelta(seconds=TIMEOUT_S),
    "allow_http": True,  # if AWS_ENDPOINT_URL says so
}
RETRIES: "RetryConfig" = {
    "max_retries": 3,
    "retry_timeout": timedelta(seconds=TRIES_S),
    "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=1), "base": 2},
}


class Bucket:
    """Objects under one prefix; usable from any thread."""

    def __init__(self, store: S3Store | MemoryStore) -> None:
        """Use a store of obstore's."""
        self._store = store
        self._lock = threading.Lock()
        self._rests_until_s = 0.0
        self.failures = 0
        """Count of the calls that the store did not answer."""

    def get(self, name: str) -> bytes | None:
        """An object's bytes; None: there is no such object.

        Raises:
            AwayError: the store does not answer.
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
            AwayError: the store does not answer.
        """
        if not size_bytes:
            return b""
        with self._answers(f"read {name}"):
            try:
                data = bytes(self._store.get_range(name, start=start, length=size_bytes))
            except FileNotFoundError:
                self._check_mark(name)
                return None
        return data if len(data) == size_bytes else None

    def put(self, name: str, data: bytes) -> None:
        """Write an object.

        Raises:
            AwayError: the store does not take it.
        """
        with self._answers(f"write {name}"):
            self._store.put(name, data, use_multipart=False)

    def put_all(self, objects: Sequence[tuple[str, bytes]]) -> None:
        """Write some objects, several at a time.

        Raises:
            AwayError: the store does not take one of them; others may be there.
        """
        if len(objects) == 1:
            self.put(*objects[0])
            return
        with ThreadPoolExecutor(min(WRITERS, len(objects) or 1), "cairn-objects") as pool:
            for done in [pool.submit(self.put, name, data) for name, data in objects]:
                done.result()

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

    def names(self, prefix: str) -> Iterator[list[str]]:
        """Names of all objects whose names begin so, some at a time.

        Raises:
            AwayError: the store does not answer.
        """
        with self._answers(f"list {prefix}"):
            for page in self._store.list(prefix, chunk_size=PAGE):
                yield [found["path"] for found in page]

    def _check_mark(self, name: str) -> None:
        """Refuse to call an object lost in a bucket that lost its mark, too: it may be a wrong or an empty one.

        Raises:
            FileNotFoundError: there is no mark either.
        """
        if name != MARK:
            self._store.head(MARK)

    @contextmanager
    def _answers(self, what: str) -> Iterator[None]:
        with self._lock:
            now_s = time.monotonic()
            if now_s < self._rests_until_s:
                raise AwayError(f"cannot {what}: the object store did not answer a moment ago")
            # Until this call is over, at most one in `REST_S` tries a store that failed.
            if self._rests_until_s:
                self._rests_until_s = now_s + REST_S
        try:
            yield
        except (BaseError, OSError) as exc:
            with self._lock:
                self._rests_until_s = time.monotonic() + REST_S
                self.failures += 1
            raise AwayError(f"cannot {what}: {_cause(exc)}") from exc
        with self._lock:
            self._rests_until_s = 0.0


def open_bucket(url: str) -> Bucket:
    """The bucket of a URL, s3://BUCKET/PREFIX; nothing is asked of it yet.

    Raises:
        AwayError: the URL or the environment does not fit.
    """
    try:
        store = from_url(url, client_options=CLIENT, retry_config=RETRIES)
    except (BaseError, ValueError, TypeError) as exc:
        raise AwayError(_cause(exc)) from exc
    if not isinstance(store, S3Store):
        raise AwayError("only s3://BUCKET/PREFIX is known")
    return Bucket(store)


def _cause(exc: Exception) -> str:
    """First line of an error of obstore's, whose others are for its developers."""
    return str(exc).strip().partition("\n")[0][:300] or type(exc).__name__
