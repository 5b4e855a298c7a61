"""List of the tokens that were ended, next to the store and in no backup, so that a restore does not revive them.

    LIST_NAME    first line: the list's id; then the SHA-256 of each secret that ended, in hex, a line each
    ended_list   the same id, in the store and so in every backup of it

A token ends when it is revoked, rotated or replaced by a registration, or when its robot is deregistered or its map
deleted. Its line is on the disk before that is written to the store, and before it is answered. A list says all that
ended since a backup if the backup bears its id: a new list, with another id, begins where a folder has none.
"""

import os
import secrets
from collections.abc import Collection
from pathlib import Path

import apsw

from cairn_map.errors import BadInputError
from cairn_server.store.sqlite.failures import disk_full
from cairn_server.store.sqlite.writer import first, rows

LIST_NAME = "ended-tokens"
ID_BYTES = 16
HASH_DIGITS = 64


class EndedTokens:
    """The list of one folder; for the writer's thread."""

    def __init__(self, path: Path, connection: apsw.Connection) -> None:
        """Open a folder's list, or begin one.

        Raises:
            BadInputError: kind `bad_store`: it cannot be written.
        """
        self._path = path
        known = first(connection, "SELECT id FROM ended_list")
        try:
            if known is None or list_id(path) != known:
                self._begin(connection)
        except OSError as exc:
            raise BadInputError("bad_store", f"cannot keep {path}: {exc.strerror}") from exc

    def note_named(self, connection: apsw.Connection, name: str) -> None:
        """Write down a token's hash, before a job changes or deletes it; raises as `_note`."""
        self._note(rows(connection, "SELECT hash FROM token WHERE name = ?", (name,)))

    def note_robot(self, connection: apsw.Connection, map_number: int, robot: str) -> None:
        """Write down the hashes of a robot's tokens, before a job deletes them; raises as `_note`."""
        self._note(rows(connection, "SELECT hash FROM token WHERE map = ? AND robot = ?", (map_number, robot)))

    def note_map(self, connection: apsw.Connection, map_number: int) -> None:
        """Write down the hashes of a map's tokens, before a job deletes them; raises as `_note`."""
        self._note(rows(connection, "SELECT hash FROM token WHERE map = ?", (map_number,)))

    def _note(self, found: list[tuple[bytes]]) -> None:
        """Write down hashes.

        Raises:
            UnreachableError: kind `disk_full`: they cannot be written down, and so must not end.
        """
        if not found:
            return
        try:
            _append(self._path, [secret_hash.hex() for (secret_hash,) in found])
        except OSError as exc:
            raise disk_full(f"{self._path} cannot be written: {exc.strerror}") from exc

    def _begin(self, connection: apsw.Connection) -> None:
        """Begin a list: file first, so that no store bears the id of a list that is not there."""
        new = secrets.token_hex(ID_BYTES)
        self._path.unlink(missing_ok=True)
        _append(self._path, [new])
        with connection:
            connection.execute("DELETE FROM ended_list")
            connection.execute("INSERT INTO ended_list VALUES (?)", (new,))


def list_id(path: Path) -> str | None:
    """Id of a list; None if there is none."""
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            return file.readline().strip() or None
    except FileNotFoundError:
        return None


def ended_since(path: Path, store: Path) -> Collection[bytes] | None:
    """SHA-256 of the secrets that ended since a backup, and before; None if no list of the backup's id is there."""
    connection = apsw.Connection(str(store))
    try:
        known = first(connection, "SELECT id FROM ended_list")
    finally:
        connection.close()
    if known is None or list_id(path) != known:
        return None
    lines = path.read_text(encoding="ascii", errors="replace").split()[1:]
    # A line that a power cut left short names a token that did not end: its job was not written.
    return {bytes.fromhex(line) for line in lines if len(line) == HASH_DIGITS and _is_hex(line)}


def copy_list(source: Path, target: Path) -> None:
    """Copy a list into a new folder, durable on return."""
    target.unlink(missing_ok=True)
    _append(target, source.read_text(encoding="ascii", errors="replace").split())


def _append(path: Path, lines: Collection[str]) -> None:
    """Add lines, durable on return. They begin on a line of their own, whatever a power cut left."""
    is_new = not path.exists()
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    try:
        text = "".join(f"{line}\n" for line in lines)
        os.write(descriptor, (text if is_new else "\n" + text).encode())
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if is_new:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _is_hex(text: str) -> bool:
    return all(digit in "0123456789abcdef" for digit in text)
