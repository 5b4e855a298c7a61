"""Responses of a server as values: lists, cells, errors."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated
from unicodedata import category

from pydantic import FailFast, TypeAdapter, ValidationError

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
from cairn_map.wire.messages import Message, Problem, check_json_size

RETRY_AFTER_MAX_S = 3600.0
"""Longest wait that a server may ask for: with a longer one, its clock or its settings may be broken."""
KIND = re.compile(r"[a-z][a-z_]{0,63}")
DETAIL_LENGTH_MAX = 1000
"""Characters of a problem's detail: PROTOCOL.md 6."""
BREAKS = re.compile("[\n\v\f\r\x1c-\x1e\x85\u2028\u2029]+")
STEERING = frozenset({"Cc", "Cf", "Co", "Cs", "Zl", "Zp"})
"""Unicode's categories of what steers or does not show: control, format, private use, halves of pairs, line ends."""


@dataclass(slots=True)
class Traffic:
    """Body bytes sent and received so far."""

    up_bytes: int = 0
    down_bytes: int = 0


@dataclass(frozen=True, slots=True)
class TimeSample:
    """The server's time in one answer, and this machine's steady time then: the middle of question and answer."""

    server_s: float
    steady_s: float
    error_s: float
    """Half of the time between question and answer: the bound of the error of `server_s - steady_s`."""


def narrower(one: TimeSample | None, other: TimeSample | None) -> TimeSample | None:
    """The sample that says more; None if there is none."""
    if one is None or other is None:
        return one or other
    return one if one.error_s <= other.error_s else other


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
    check_json_size(data)
    try:
        whole: TypeAdapter[list[Message]] = TypeAdapter(Annotated[list[model], FailFast()])  # type: ignore[valid-type, arg-type]
        return whole.validate_json(data)
    except ValidationError as exc:
        raise DamagedDataError("bad_message", f"the server's list is not sound: {first_error(exc)}") from exc


def error_of(status: int, retry_after: str, body: bytes) -> CairnError:
    """The error that the server's problem body states; `retry_after` is the header of that name, or empty."""
    try:
        problem = Problem.model_validate_json(body)
        if not KIND.fullmatch(problem.kind):
            raise ValueError
    except ValueError:  # pydantic's ValidationError is one
        problem = Problem(kind="http", detail=f"the server answered {status}: {body[:200].decode(errors='replace')}")
    detail = one_line(problem.detail[:DETAIL_LENGTH_MAX])
    if status in (425, 429, 502, 503, 504, 507):
        wait_s = min(float(retry_after[:20]), RETRY_AFTER_MAX_S) if retry_after.isdecimal() else None
        return UnreachableError(problem.kind, detail, wait_s)
    families: dict[int, type[CairnError]] = {
        401: DeniedError,
        403: DeniedError,
        404: NotFoundError,
        409: ConflictError,
        410: ConflictError,
    }
    family = families.get(status, BadInputError if status < 500 else DamagedDataError)
    if (status, problem.kind) == (410, "gone"):  # the map; another log answers for the same one
        family = NotFoundError
    return family(problem.kind, detail)


def shown_text(text: str) -> str:
    """A text of another program as it may be shown: without characters that a terminal would obey, or that hide."""
    return "".join(
        char if char in "\t\n" or category(char) not in STEERING else "\N{REPLACEMENT CHARACTER}" for char in text
    )


def one_line(text: str) -> str:
    """A text of another program as a part of a line: it cannot look like lines of the command's own."""
    return shown_text(BREAKS.sub(" ", text))
