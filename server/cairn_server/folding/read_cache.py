"""Caches of cells that were read last and of changes made of them: every robot of a team asks for the same few.

history     the newest log entries of a cell                 } of its state at one `lm`; each is made
stamps      entry that changed each of its blocks            } once for all concurrent requests
evidence    all of it, decoded, row by row: the costly part  }
change      frame content for robots at an older entry       }
diff        what one entry did to it, decoded: robots at many older entries need sums of the same ones
"""

from dataclasses import dataclass

from cairn_map.commits.ids import Author
from cairn_map.epochs.cell_history import CellHistory
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.blocks import Blocks
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.wire.frames import FrameKind
from cairn_server.folding.cells_at_rest import stored_diff, stored_history, stored_stamps
from cairn_server.folding.single_flight import MadeOnce
from cairn_server.store.stamps import Stamps
from cairn_server.store.store import Snapshot
from cairn_server.store.store_rows import CellRow, Contribution

EVIDENCE_BYTES = 224 << 20
"""Memory for the decoded cells of all maps."""
STAMPS_BYTES = 32 << 20
CHANGES_BYTES = 64 << 20
HISTORIES_BYTES = 16 << 20
DIFFS_BYTES = 32 << 20
ENTRY_BYTES = 300
"""Memory of one entry of a history, or of one empty change."""
State = tuple[bytes | None, CellKey, bytes, int]
"""State of a cell: chain at its `lm`, cell, digest, `gone_seq`."""


@dataclass(frozen=True, slots=True)
class Change:
    """Content of a frame, the same for all robots between the same two log entries of a cell."""

    kind: FrameKind
    payload: bytes
    blocks: Blocks | None = None


@dataclass(frozen=True, slots=True)
class ChangeName:
    """Key of a change: all that it depends on."""

    state: State
    after_seq: int
    own: Author | None
    """Author whose commits are left out; None: none are."""
    kinds: frozenset[str]


class ReadCache:
    """Caches of all maps; thread-safe. Callers must not change the values."""

    def __init__(self, *, share: float = 1.0) -> None:
        """Make empty caches, each of this part of its standard size."""
        self._evidence: MadeOnce[State, CellHistory] = MadeOnce(
            limit_bytes=int(share * EVIDENCE_BYTES), size_of=lambda evidence: evidence.size_bytes
        )
        self._stamps: MadeOnce[State, Stamps] = MadeOnce(
            limit_bytes=int(share * STAMPS_BYTES), size_of=lambda stamps: stamps.nbytes
        )
        self._histories: MadeOnce[State, list[Contribution]] = MadeOnce(
            limit_bytes=int(share * HISTORIES_BYTES), size_of=lambda entries: ENTRY_BYTES * (1 + len(entries))
        )
        self._diffs: MadeOnce[tuple[bytes | None, CellKey], Evidence] = MadeOnce(
            limit_bytes=int(share * DIFFS_BYTES), size_of=lambda diff: ENTRY_BYTES + diff.size_bytes
        )
        self.changes: MadeOnce[ChangeName, Change | None] = MadeOnce(
            limit_bytes=int(share * CHANGES_BYTES), size_of=_change_bytes
        )

    def evidence(self, snapshot: Snapshot, listed: CellRow, layer: MapLayer) -> CellHistory:
        """Evidence of a listed cell, by epoch.

        Raises:
            DamagedDataError: kind `damaged_store`: the cell at rest is not sound.
        """
        return self._evidence.get(state_of(snapshot, listed), lambda: stored_history(_stored(snapshot, listed), layer))

    def stamps(self, snapshot: Snapshot, listed: CellRow, geometry: Geometry) -> Stamps:
        """Stamps of a listed cell.

        Raises:
            DamagedDataError: kind `damaged_store`: the cell is not there.
        """
        state = state_of(snapshot, listed)
        return self._stamps.get(state, lambda: stored_stamps(_stored(snapshot, listed), geometry))

    def history(self, snapshot: Snapshot, listed: CellRow, *, limit: int) -> list[Contribution]:
        """Newest log entries of a listed cell, oldest first; every call must have the same limit."""
        state = state_of(snapshot, listed)
        return self._histories.get(state, lambda: snapshot.contributions(listed.key, after_seq=0, newest=limit))

    def diff(self, snapshot: Snapshot, key: CellKey, contribution: Contribution) -> Evidence:
        """Evidence of the commit of a log entry about a cell.

        Raises:
            DamagedDataError: kind `damaged_store`: it is not sound, or not kept any more.
        """
        name = snapshot.chain_at(contribution.seq), key
        return self._diffs.get(name, lambda: stored_diff(snapshot, key, contribution))


def state_of(snapshot: Snapshot, listed: CellRow) -> State:
    """Key that tells the states of all cells of all maps apart, those of histories that a restore took away, too."""
    return snapshot.chain_at(listed.lm), listed.key, listed.digest, listed.gone_seq


def _stored(snapshot: Snapshot, listed: CellRow) -> CellRow:
    stored = snapshot.cell(listed.key)
    if stored is None:
        raise DamagedDataError("damaged_store", f"cell {cell_of_key(listed.key)} is listed, but is not there")
    return stored


def _change_bytes(change: Change | None) -> int:
    if change is None:
        return ENTRY_BYTES
    return ENTRY_BYTES + len(change.payload) + (change.blocks.nbytes if change.blocks is not None else 0)
