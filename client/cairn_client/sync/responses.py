"""Responses of a server as values: lists, cells, errors."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cairn_map.commits.cursor import Cursor
from cairn_map.commits.version_vector import VersionVector
from cairn_map.errors import (
    BadInputError,
    CairnError,
    ConflictError,
    DamagedDataError,
    DeniedError,
    NotFoundError,
    UnreachableError,
    first_error,
)
from cairn_map.evidence.fingerprint import Fingerprint
from cairn_map.wire.messages import Message, Problem


@dataclass(slots=True)
class Traffic:
    """Body bytes sent and received so far."""

    up_bytes: int = 0
    down_bytes: int = 0

    def counted(self, parts: Iterable[bytes]) -> Iterator[bytes]:
        """The parts of an answer, counted as they come."""
        for part in parts:
            self.down_bytes += len(part)
            yield part


@dataclass(frozen=True, slots=True)
class Answer:
    """A complete answer that is no error."""

    status: int
    headers: Mapping[str, str]
    """Header fields; their names regardless of case."""
    body: bytes


@dataclass(frozen=True, slots=True)
class FetchedCell:
    """A cell as downloaded; `body` is None if it is still the one that the asker has."""

    body: bytes | None
    etag: str
    cursor: Cursor
    coverage: VersionVector
    fingerprint: Fingerprint


def list_of(model: type[Message], data: bytes) -> list[Message]:
    """A checked list of messages.

    Raises:
        DamagedDataError: it is none.
    """
    try:
        found: list[Message] = TypeAdapter(list[model]).validate_json(data)  # type: ignore[valid-type]
        return found
    except ValidationError as exc:
        raise DamagedDataError("bad_message", f"the server's list is not sound: {first_error(exc)}") from exc


def error_of(status: int, retry_after: str, body: bytes) -> CairnError:
    """The error that the server's problem body states; `retry_after` is the header of that name, or empty."""
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError:
        problem = Problem(kind="http", detail=f"the server answered {status}: {body[:200].decode(errors='replace')}")
    if status in (429, 502, 503, 504, 507):
        wait_s = float(retry_after) if retry_after.isdecimal() else None
        return UnreachableError(problem.kind, problem.detail, wait_s)
    families: dict[int, type[CairnError]] = {
        401: DeniedError,
        403: DeniedError,
        404: NotFoundError,
        409: ConflictError,
        410: ConflictError,
    }
    family = families.get(status, BadInputError if status < 500 else DamagedDataError)
    return family(problem.kind, problem.detail)


def unreachable(exc: Any) -> UnreachableError:
    """The `UnreachableError` of a request that failed by httpx's `TransportError`."""
    try:
        where = str(exc.request.url.copy_with(path="/", query=None))
    except RuntimeError:
        where = "the server"
    if "CERTIFICATE_VERIFY_FAILED" in str(exc):
        return UnreachableError(
            "no_link", f"{where} shows a certificate of an unknown issuer; name the issuer's file in SSL_CERT_FILE"
        )
    return UnreachableError("no_link", f"cannot reach {where} ({exc or type(exc).__name__}); is `cairn serve` running?")
