"""Folding in a process of its own, which plans what the server then writes.

    server ── fold a group of this map ──> process     reads the store
           <── cells, entries, new head ──             (`store_rows.Fold`)
           ── written, or not ──>
           <── so many folded ──

In a thread of the server, folding took the interpreter from those that answer robots, at each of their kernels and
system calls: pushes were half as many. The process is forked before the server has threads or a store open, so it
costs no start of its own. It holds no lock and writes nothing: it can be killed at any instant. Then the server folds
in its own thread until it is started anew.
"""

import logging
import os
import signal
import socket
import traceback
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from cairn_map.errors import CairnError
from cairn_map.evidence.grid import CellKey
from cairn_server.folding.folding import Damage, FoldStore
from cairn_server.folding.group_folding import Folded, LocalFolding
from cairn_server.processes import die_with_parent
from cairn_server.store.sqlite.readers import Readers
from cairn_server.store.sqlite.reads import SqliteReads
from cairn_server.store.store_rows import Fold, MapRow

log = logging.getLogger(__name__)


class LostProcessError(Exception):
    """The process ended."""


class BrokenFoldError(Exception):
    """Something in the process that nobody expected; the message is its traceback."""


@dataclass(frozen=True, slots=True)
class _Ask:
    """Fold a group of this map."""

    row: MapRow
    maps: int
    healed: int


@dataclass(frozen=True, slots=True)
class _Write:
    """Write this; answered with whether it was."""

    fold: Fold


@dataclass(frozen=True, slots=True)
class _Audit:
    what: str
    detail: str


@dataclass(frozen=True, slots=True)
class _Note:
    """Cells that are damaged, or (`is_sound`) are not any more."""

    keys: tuple[CellKey, ...]
    is_sound: bool


@dataclass(frozen=True, slots=True)
class _Log:
    name: str
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class _Failed:
    error: CairnError | None
    """None: the server's own, which it remembers."""
    broken: str = ""


class FoldProcess:
    """The server's end; one thread at a time."""

    def __init__(self, link: Connection, *, pid: int | None) -> None:
        self.pid = pid
        """None: the other end is no process of its own."""
        self._link = link

    def fold(self, row: MapRow, store: FoldStore, damaged: Damage, *, maps: int) -> Folded:
        """As `LocalFolding.fold`; what it makes is written to the store here.

        Raises:
            CairnError: nothing was folded.
            LostProcessError: the process is no more; what it had begun was not written.
            BrokenFoldError: it met an error of its own.
        """
        failure: BaseException | None = None
        try:
            self._link.send(_Ask(row, maps, damaged.healed(row.name)))
            while True:
                match self._link.recv():
                    case Folded() as folded:
                        return folded
                    case _Write(fold):
                        try:
                            is_written = store.fold(row, fold)
                        except Exception as exc:  # noqa: BLE001 - raised once the process knows
                            failure, is_written = exc, None
                        self._link.send(is_written)
                    case _Failed(error, broken):
                        failure = error or failure or BrokenFoldError(broken)
                        break
                    case _Audit(what, detail):
                        store.audit(what, detail)
                    case _Note(keys, True):
                        for key in keys:
                            damaged.forget(row.name, key)
                    case _Note(keys, False):
                        damaged.note(row.name, keys)
                    case _Log(name, level, text):
                        logging.getLogger(name).log(level, "%s", text)
        except (EOFError, OSError) as exc:
            raise LostProcessError from exc
        raise failure

    def close(self) -> None:
        """End it."""
        self._link.close()
        if self.pid is not None:
            os.waitpid(self.pid, 0)


def fork_folding(store_file: Path) -> FoldProcess:
    """A process for the store in this file, which need not be there yet. Only before there are threads."""
    ours, theirs = socket.socketpair()
    server = os.getpid()
    pid = os.fork()
    if pid == 0:
        ours.close()
        try:
            die_with_parent(server)
            _be_folder(Connection(theirs.detach()), store_file)
        finally:
            os._exit(0)
    theirs.close()
    return FoldProcess(Connection(ours.detach()), pid=pid)


def _be_folder(link: Connection, store_file: Path) -> None:
    """What the process does."""
    for number in (signal.SIGINT, signal.SIGTERM):  # of a whole group: the server first finishes what it does
        signal.signal(number, signal.SIG_IGN)
    logging.basicConfig(handlers=[_FarLog(link)], force=True)
    answer_folds(link, Readers(store_file))


def answer_folds(link: Connection, readers: Readers) -> None:
    """Plan what the other end asks for, until it is gone."""
    far = _FarStore(readers, link)
    here = LocalFolding(far, far.damaged)
    with suppress(EOFError, OSError):
        while True:
            ask: _Ask = link.recv()
            far.damaged.count = ask.healed
            link.send(_answer(here, ask))


def _answer(here: LocalFolding, ask: _Ask) -> Folded | _Failed:
    try:
        return here.fold(ask.row, maps=ask.maps)
    except _NotWrittenError:
        return _Failed(None)
    except CairnError as exc:
        return _Failed(exc)
    except (EOFError, OSError):
        raise
    except Exception:  # noqa: BLE001 - told to the server, which logs it and tries again
        return _Failed(None, traceback.format_exc())


class _NotWrittenError(Exception):
    """The server could not write; it knows why."""


class _FarStore(SqliteReads):
    """`FoldStore` that reads the file, and has the server write."""

    def __init__(self, readers: Readers, link: Connection) -> None:
        super().__init__(readers)
        self._link = link
        self.damaged = _FarDamage(link)

    def fold(self, row: MapRow, fold: Fold) -> bool:
        self._link.send(_Write(fold))
        is_written: bool | None = self._link.recv()
        if is_written is None:
            raise _NotWrittenError
        return is_written

    def audit(self, what: str, detail: str) -> None:
        self._link.send(_Audit(what, detail))


class _FarDamage:
    """`Damage` that the server hears of."""

    def __init__(self, link: Connection) -> None:
        self.count = 0
        """Healed cells when the server asked last."""
        self._link = link

    def note(self, map_name: str, keys: Iterable[CellKey]) -> None:
        self._link.send(_Note(tuple(keys), is_sound=False))

    def forget(self, map_name: str, key: CellKey) -> None:
        self._link.send(_Note((key,), is_sound=True))

    def healed(self, map_name: str) -> int:
        return self.count


class _FarLog(logging.Handler):
    """Log lines, written by the server."""

    def __init__(self, link: Connection) -> None:
        super().__init__()
        self._link = link

    def emit(self, record: logging.LogRecord) -> None:
        self._link.send(_Log(record.name, record.levelno, record.getMessage()))
