"""What a command's exit code says; the one place of it."""

from cairn_map.errors import CairnError, ConflictError, DamagedDataError, NotFoundError, UnreachableError

DONE, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
OF_FAMILY: tuple[tuple[type[CairnError], int], ...] = (
    (NotFoundError, 3),
    (ConflictError, 4),
    (UnreachableError, 5),
    (DamagedDataError, 6),
)
EXIT_CODES = (
    "exit codes: 0 done, 1 refused or impossible as asked, 2 wrong usage, 3 not found, 4 conflict, 5 no link,\n"
    "  6 damaged data, 130 interrupted; the cause and its [kind] are on standard error"
)
"""For the end of every --help."""


def exit_code_of(exc: CairnError) -> int:
    """The code of a command that ends with this error."""
    return next((code for family, code in OF_FAMILY if isinstance(exc, family)), FAILED)
