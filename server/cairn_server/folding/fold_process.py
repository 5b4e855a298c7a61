"""Folding in a process of its own, which plans each fold; the server writes it.

    server ── fold a group of this map ──> process     reads the store
           <── cells, entries, new head ──             (`store_rows.Fold`)
           ── written, or not ──>
           <── so many folded ──

In a thread of the server, folding took the interpreter from those that answer robots, at each of their kernels and
system calls: pushes were half as many. The process is forked before the server has threads or a store open, so it
costs no start of its own. It holds no lock and writes nothing: it can be killed at any instant. Then the server folds
in its own thread until its next start.
"""

import logging
import os
import traceback
from collections.abc import Callable, Collection, Iterable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection

from cairn_map.commits.ids import CommitId
from cairn_map.errors import CairnError
from cairn_map.evidence.grid import CellKey
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.folding import Damage, FoldReads, FoldStore
from cairn_server.folding.group_folding import Folded, LocalFolding
from cairn_server.processes import fork
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import Fold, MapRow, StoredCommit

log = logging.getLogger(__name__)


class LostProcessError(Exception):
    """The process ended."""


class BrokenFoldError(Exception):
    """An unexpected error in the process; the message is its traceback."""


@dataclass(frozen=True, slots=True)
class _Ask:
    """Request to fold a group of this map; `healed` is `Damage.healed` of it."""

    row: MapRow
    healed: int
    is_news: bool


@dataclass(frozen=True, slots=True)
class _Write:
    """Request to write a fold; the answer is True if it was written, None if writing failed."""

    fold: Fold


@dataclass(frozen=True, slots=True)
class _Audit:
    """Line for the audit log."""

    what: str
    detail: str


@dataclass(frozen=True, slots=True)
class _Note:
    """Cells found damaged, or (`is_sound`) found sound again."""

    keys: tuple[CellKey, ...]
    is_sound: bool


@dataclass(frozen=True, slots=True)
class _Log:
    """Line for the server's log."""

    name: str
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class _Failed:
    """Failure of the fold asked for."""

    error: CairnError | None
    """Error of the fold; None: the server's own error while it wrote, or an unexpected one."""
    broken: str = ""
    """Traceback of an unexpected error."""


class FoldProcess:
    """The server's end of the link to the process; one thread at a time."""

    def __init__(self, link: Connection, *, pid: int | None) -> None:
        self.pid = pid
        """Number of the process; None: the other end is no process of its own."""
        self._link = link

    def fold(self, row: MapRow, store: FoldStore, damaged: Damage, *, is_news: bool = True) -> Folded:
        """Fold one group as `LocalFolding.fold` does: planned in the process, written to the store here.

        Raises:
            CairnError: nothing was folded.
            LostProcessError: the process has ended; what it had begun was not written.
            BrokenFoldError: the process met an unexpected error.
        """
        failure: BaseException | None = None
        try:
            self._link.send(_Ask(row, damaged.healed(row.name), is_news))
            # Until the process says how it ended, it may ask to write, and report damage and log lines.
            while True:
                match self._link.recv():
                    case Folded() as folded:
                        return folded
                    case _Write(fold):
                        # The process must hear of it in any case: it waits for this answer.
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
        """End the process."""
        self._link.close()
        if self.pid is not None:
            os.waitpid(self.pid, 0)


def fork_folding(reads_of: Callable[[], FoldReads], memory: FoldMemory | None = None) -> FoldProcess:
    """Fork a process that folds; only before there are threads.

    Args:
        reads_of: called in the process, returns what reads the store, which need not be made before the first fold.
        memory: for folding.
    """
    link, pid = fork(partial(_be_folder, reads_of=reads_of, memory=memory))
    return FoldProcess(link, pid=pid)


def _be_folder(link: Connection, reads_of: Callable[[], FoldReads], memory: FoldMemory | None) -> None:
    """Run the process's side until the server is gone."""
    # Its log lines go to the server: two processes would write over each other's.
    logging.basicConfig(handlers=[_FarLog(link)], force=True)
    answer_folds(link, reads_of(), memory)


def answer_folds(link: Connection, reads: FoldReads, memory: FoldMemory | None = None) -> None:
    """Plan the folds that the other end asks for, until it is gone."""
    far = _FarStore(reads, link)
    here = LocalFolding(far, far.damaged, memory)
    with suppress(EOFError, OSError):
        while True:
            ask: _Ask = link.recv()
            far.damaged.begin(ask.healed)
            link.send(_answer(here, ask))


def _answer(here: LocalFolding, ask: _Ask) -> Folded | _Failed:
    try:
        return here.fold(ask.row, is_news=ask.is_news)
    except _NotWrittenError:
        return _Failed(None)
    except CairnError as exc:
        return _Failed(exc)
    except (EOFError, OSError):
        raise
    except Exception:  # noqa: BLE001 - reported to the server, which logs it and tries again
        return _Failed(None, traceback.format_exc())


class _NotWrittenError(Exception):
    """The server could not write; its side keeps the reason."""


class _FarStore:
    """`FoldStore` that reads the store itself and has the server write."""

    def __init__(self, reads: FoldReads, link: Connection) -> None:
        self._reads = reads
        self._link = link
        self.damaged = _FarDamage(link)

    def pending(
        self, row: MapRow, *, limit: int, size_bytes_max: int, skip: Collection[int] = ()
    ) -> list[StoredCommit]:
        return self._reads.pending(row, limit=limit, size_bytes_max=size_bytes_max, skip=skip)

    def folded(self, row: MapRow, commit: CommitId) -> StoredCommit | None:
        return self._reads.folded(row, commit)

    def is_retracted(self, row: MapRow, commit: CommitId) -> bool:
        return self._reads.is_retracted(row, commit)

    def snapshot(self, row: MapRow) -> AbstractContextManager[Snapshot]:
        return self._reads.snapshot(row)

    def fold(self, row: MapRow, fold: Fold) -> bool:
        self._link.send(_Write(fold))
        is_written: bool | None = self._link.recv()
        if is_written is None:
            raise _NotWrittenError
        return is_written

    def audit(self, what: str, detail: str) -> None:
        self._link.send(_Audit(what, detail))


class _FarDamage:
    """`Damage` that is reported to the server."""

    def __init__(self, link: Connection) -> None:
        self._healed = 0
        self._link = link

    def begin(self, healed: int) -> None:
        """Take over the server's count of healed cells, with each request."""
        self._healed = healed

    def note(self, map_name: str, keys: Iterable[CellKey]) -> None:
        self._link.send(_Note(tuple(keys), is_sound=False))

    def forget(self, map_name: str, key: CellKey) -> None:
        self._link.send(_Note((key,), is_sound=True))

    def healed(self, map_name: str) -> int:
        return self._healed


class _FarLog(logging.Handler):
    """Handler that has the server write the process's log lines."""

    def __init__(self, link: Connection) -> None:
        super().__init__()
        self._link = link

    def emit(self, record: logging.LogRecord) -> None:
        self._link.send(_Log(record.name, record.levelno, record.getMessage()))
