"""Every error that cairn raises on purpose, grouped by what a handler would do about it.

    CairnError
    ├── BadInputError      the caller must change its request: bad geometry, bad bytes, too large
    │   └── DeniedError    the caller must show another token
    ├── NotFoundError      nothing is there, and that is certain
    ├── ConflictError      it contradicts what is already kept; asking again will not help
    ├── DamagedDataError   bytes that should be sound are not; fetch them again or restore
    └── UnreachableError   the other side does not answer (now); try again later

`kind` is a stable code in snake case. The same code travels in the server's RFC 9457 problem
body and comes out of the client, so that `except ConflictError as exc: exc.kind` reads alike on
both sides of the wire. Codes are added, never renamed. The exit codes of commands follow the same families.
"""

from pydantic import ValidationError

COMPLAINTS_MAX = 1000
"""About a kilobyte each."""


class CairnError(Exception):
    """Root of the family; `kind` says which one, the message says what was expected and what came."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind
        self.message = message

    def __reduce__(self) -> tuple[type["CairnError"], tuple[str, str]]:
        return type(self), (self.kind, self.message)


class BadInputError(CairnError):
    """The request cannot be fulfilled as it is."""


class DeniedError(BadInputError):
    """The token is missing, unknown, or not for this."""


class NotFoundError(CairnError):
    """The thing named does not exist."""


class ConflictError(CairnError):
    """The request contradicts data that is already kept."""


class DamagedDataError(CairnError):
    """Bytes that cannot be what they claim to be."""


class UnreachableError(CairnError):
    """The other side cannot be reached, or cannot answer now.

    `retry_after_s` is the server's own wish, where it stated one.
    """

    def __init__(self, kind: str, message: str, retry_after_s: float | None = None) -> None:
        super().__init__(kind, message)
        self.retry_after_s = retry_after_s


def first_error(exc: ValidationError) -> str:
    """Place and text of a model's first complaint, short; the others, perhaps a million, are not even listed."""
    if exc.error_count() > COMPLAINTS_MAX:
        return f"more than {COMPLAINTS_MAX} fields are wrong"
    first = exc.errors(include_url=False, include_context=False, include_input=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    said = complaint_text(first["msg"])[:200]
    return f"{where[:200]}: {said}" if where else said


def complaint_text(message: str) -> str:
    """A model's complaint without the words that pydantic puts before those of a validator of ours."""
    return message.removeprefix("Value error, ").removeprefix("Assertion failed, ")


def exit_code_of(exc: CairnError) -> int:
    """The code of a command that ends with this error."""
    return next((code for family, code in OF_FAMILY if isinstance(exc, family)), FAILED)


DONE, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
OF_FAMILY: tuple[tuple[type[CairnError], int], ...] = (
    (NotFoundError, 3),
    (ConflictError, 4),
    (UnreachableError, 5),
    (DamagedDataError, 6),
)
EXIT_CODES = (
    "exit codes: 0 done, 1 refused or impossible as asked, 2 wrong usage, 3 not found, 4 conflict, 5 no link\n"
    "  or not now, 6 damaged data, 130 interrupted; the cause and its [kind] are on standard error"
)
"""Last lines of every --help."""
