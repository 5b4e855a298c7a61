"""SQLite's errors about a robot's file as ours."""

from pathlib import Path

import apsw

from cairn_map.errors import CairnError, ConflictError, DamagedDataError, UnreachableError


def failure_of(exc: apsw.Error, file: Path) -> CairnError:
    """What a handler would do about it."""
    if isinstance(exc, apsw.BusyError):
        return ConflictError("folder_in_use", f"another robot has {file} open; stop it, or choose another folder")
    if isinstance(exc, apsw.CorruptError | apsw.NotADBError | apsw.SQLError):
        return DamagedDataError("damaged_store", f"{file} is damaged: {exc}; move it away to start anew")
    return UnreachableError("store_failed", f"cannot use {file}: {exc}")
