"""A robot's map without the network: what it made itself, what it has from the server, and the sum that it sees.

    outbox   own commits, until no restore can lose them              (SYNC.md rule 12)
    base     per cell the server's state at a cursor, and its coverage: the ids in it
    view     base + the commits in the outbox that the cell's coverage lacks, without what they take out  (rule 7)

Everything durable changes in one local transaction; everything is called under one lock.
"""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from cairn_client.replica.map_model import stored_model
from cairn_client.replica.outbox import Outbox
from cairn_client.replica.refused_commits import Resting
from cairn_client.replica.replica_identity import identify
from cairn_client.replica.replica_store import BaseCell, KeptCommit, ReplicaStore
from cairn_client.replica.view_of_cell import changes, is_to_be_taken, shown_evidence, taken_back
from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.commits.commit import Commit, CommitMeta
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import OPERATOR, Author, CommitId, RobotName, commit_id_from_text
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.errors import CairnError
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.fingerprint import ZERO, fingerprint
from cairn_map.evidence.grid import Cell, CellKey, Geometry, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.queries.map_snapshot import MapSnapshot, snapshot_of
from cairn_map.wire.messages import ReplyHeader, message_from_json

log = logging.getLogger(__name__)

UNPROVEN = BaseCell(None, EMPTY, ZERO)
"""An empty base that is to be replaced by the server's whole cell."""


class Replica:
    """One robot's durable state and its view of the map."""

    def __init__(self, store: ReplicaStore, *, robot: RobotName, map_name: str, geometry: Geometry) -> None:
        """Open or make the state.

        Raises:
            BadInputError: kind `other_replica`: it is of another robot, map or grid.
        """
        self.lock = threading.RLock()
        self.store = store
        self.geometry = geometry
        self.view = EvidenceMap(geometry)
        self._snapshot: MapSnapshot | None = None
        identify(store, {"robot": robot, "map": map_name, "geometry": geometry.model_dump_json()})
        self.outbox = Outbox(store, robot, geometry)
        header = store.get("header")
        self.header: ReplyHeader | None = message_from_json(ReplyHeader, header) if header else None
        cursor = store.get("default_cursor")
        self.default_cursor: Cursor | None = cursor_from_text(cursor) if cursor else None
        """Cursor of every cell that is not held."""
        self.cells: dict[CellKey, BaseCell] = store.cells()
        self.refused_cells: set[tuple[CellKey, str]] = set()
        """Cells, with their fingerprints, by which the server would not be healed: not sent again."""
        self.resting = Resting()
        """Commits that the server refused for their bytes: not sent again for a while."""
        self.admit: Callable[[CellKey, int], None] = lambda key, size_bytes: None
        """Asked before a cell of so many bytes is held; raises if there is no room (`room`)."""
        self._load()

    @property
    def author(self) -> Author:
        """The robot in its present incarnation."""
        return self.outbox.author

    @property
    def commits(self) -> list[CommitId]:
        """Commits whose bytes are kept, oldest first."""
        with self.lock:
            return [kept.id for kept in self.outbox]

    def token(self) -> str | None:
        """The token that the server gave to this robot."""
        with self.lock:
            return self.store.get("token")

    def set_token(self, token: str | None) -> None:
        """Remember a token, or forget it."""
        with self.lock, self.store.transaction():
            self.store.put("token", token)

    def commit(
        self, diff: Mapping[CellKey, Evidence], meta: CommitMeta | None = None, *, profile: Profile = Profile.FAST
    ) -> Commit:
        """Keep evidence as the next commit, durably, and see it in the view.

        Args:
            diff: packed evidence by cell.
            meta: what to say about it; id, geometry, parent and cursor are filled in here.
            profile: how its bytes are spent.
        """
        with self.lock:
            seen = str(self.default_cursor) if self.default_cursor else None
            commit = self.outbox.add(diff, meta, seen=seen, profile=profile)
            self.view.merge({key: diff[key] for key in commit.cells})
            for gone in taken_back(self.outbox, commit, self.geometry, coverage_of=self._coverage):
                self.view.unmerge(gone)
            return commit

    def push_set(self) -> list[CommitId]:
        """Commits that the server may lack, oldest first."""
        with self.lock:
            return self.outbox.push_set(self.header)

    def commit_data(self, commit: CommitId) -> bytes | None:
        """Bytes of a commit of the outbox; None if they are not there any more."""
        with self.lock:
            return self.store.commit_data(commit)

    def kept_commit(self, commit: CommitId) -> Commit | None:
        """A commit of the outbox, whole; None if it is not there any more."""
        with self.lock:
            return self.outbox.whole(commit)

    def acknowledge(self, commit: CommitId) -> None:
        """The server has this commit for good."""
        with self.lock:
            self.outbox.acknowledge(commit)
            if is_to_be_taken(self.outbox, commit, coverage_of=self._coverage):
                self._refresh_views([commit])

    def lacking_retracts(self) -> list[CommitId]:
        """The operator's retracts that a restore could still lose, and that are not kept here yet."""
        with self.lock:
            named = [commit_id_from_text(text) for text in (self.header.retracts if self.header else [])]
            return [commit for commit in named if commit.author.robot == OPERATOR and not self.outbox.knows(commit)]

    def keep_sealed(self, commit: Commit, seal: str) -> None:
        """Keep a server's own retract, to push it back if the server loses it."""
        with self.lock:
            if not self.outbox.knows(commit.id):
                self.outbox.keep_sealed(commit, seal)
                self._refresh_views(commit.meta.retracted_ids)

    def seal(self, commit: CommitId) -> str | None:
        """The seal that a kept commit bears."""
        with self.lock:
            return self.outbox.seal(commit)

    def forget_commit(self, commit: CommitId) -> None:
        """Drop the bytes of a commit that is of no use any more."""
        with self.lock:
            self.outbox.forget([commit])

    def rename(self, commit: CommitId) -> CommitId:
        """Give a commit whose id is taken on the server a new one; its coverage there was another commit's."""
        with self.lock:
            renamed = self.outbox.rename(commit)
            for key in renamed.cells:
                self.refresh_view(key)
            return renamed.id

    def take_header(self, header: ReplyHeader, *, asked_by: Author) -> None:
        """Note the newest state that the server told of.

        Args:
            header: of a reply or an index.
            asked_by: the author whose tip it tells.
        """
        with self.lock:
            with self.store.transaction():
                self.store.put("header", header.model_dump_json())
            self.header = header
            self.outbox.check_tip(header, asked_by=asked_by)

    def base_evidence(self, key: CellKey) -> Evidence:
        """The server's evidence of a cell as it is held here; empty if it is damaged: its fingerprint tells then."""
        body = self.store.body(key)
        try:
            return decode_cell(body).evidence if body else empty_evidence(self.geometry)
        except CairnError as exc:
            log.error("cell %s at rest is damaged: %s", cell_of_key(key), exc.message)
            return empty_evidence(self.geometry)

    def hold(self, key: CellKey, cell: BaseCell, evidence: Evidence, *, body: bytes | None = None) -> None:
        """Make a cell's base this evidence, with its cursor and coverage, in one transaction, and show it."""
        data = body or encode_cell(key, evidence, self.geometry).data
        if len(evidence):
            self.admit(key, len(data))
        with self.store.transaction():
            self.store.put_cell(key, cell, body=data)
        self.cells[key] = cell
        self.refresh_view(key, base=evidence)

    def hold_nothing(self, key: CellKey, cell: BaseCell) -> None:
        """Make a cell's base empty."""
        self.hold(key, cell, empty_evidence(self.geometry))

    def move(self, keys: Iterable[CellKey], *, to: Cursor | None, coverage: VersionVector | None) -> None:
        """Give held cells another cursor, and coverage unless None; their evidence stays."""
        moved = list(keys)
        shown = {key: changes(self.outbox, key, self._coverage(key)) for key in moved}
        with self.store.transaction():
            self.store.move_cells(moved, to=to, coverage=coverage)
        for key in moved:
            cell = self.cells[key]
            self.cells[key] = replace(cell, cursor=to, coverage=cell.coverage if coverage is None else coverage)
            if changes(self.outbox, key, self._coverage(key)) != shown[key]:
                self.refresh_view(key)

    def set_default_cursor(self, cursor: Cursor) -> None:
        """The cursor of every cell that is not held."""
        with self.store.transaction():
            self.store.put("default_cursor", str(cursor))
        self.default_cursor = cursor

    def forget_server(self) -> None:
        """The server's log is another one now: hold nothing of it, and offer it every commit (HTTP 410)."""
        with self.lock:
            with self.store.transaction():
                self.store.drop_cells()
                self.store.clear_acked()
                self.store.put("header", None)
                self.store.put("default_cursor", None)
            self.header = self.default_cursor = None
            shown = {*self.cells, *self.outbox.cells}
            self.cells.clear()
            self.outbox.reread()
            self.resting.end()
            # Another server does not know the first one's seal.
            self.outbox.forget([kept.id for kept in self.outbox if kept.seal is not None])
            for key in shown:
                self.refresh_view(key)

    def forget_stable_commits(self, *, wanted: Callable[[Cell], bool] | None = None) -> int:
        """Drop the bytes of commits that are stable and covered in every cell they touch (rule 12); how many.

        Not of what another kept commit takes out: the server may have forgotten its evidence, and asks for it again.
        Only of acknowledged ones: after a roll-back of this robot's disk, the stable and covered commit may be another
        one under the same id.

        Args:
            wanted: the cells that this robot keeps at all; default every one.
        """
        with self.lock:
            stable = self.header.stable_vector if self.header else EMPTY
            gone = [
                kept.id for kept in self.outbox if kept.acked and kept.id in stable and self._is_covered(kept, wanted)
            ]
            named = self.outbox.named() if gone else set()
            gone = [commit for commit in gone if commit not in named]
            self.outbox.forget(gone)
            return len(gone)

    def refresh_view(self, key: CellKey, *, base: Evidence | None = None) -> None:
        """Make the view of a cell its base, changed by the commits that are kept (rule 7)."""
        base = self.base_evidence(key) if base is None else base
        self.view.replace(key, shown_evidence(self.outbox, key, base, self.geometry, coverage=self._coverage(key)))

    def snapshot(self, model: SensorModel | None = None) -> MapSnapshot:
        """The view as it is now, unmoved by what comes later, under the map's own sensor model or another one."""
        with self.lock:
            model = stored_model(self.store) if model is None else model
            if self._snapshot is not None and self._snapshot.model == model:
                self._snapshot = self._snapshot.refreshed(self.view)
            else:
                self._snapshot = snapshot_of(self.view, model)
            return self._snapshot

    def close(self) -> None:
        """Close the file."""
        with self.lock:
            self.store.close()

    def _refresh_views(self, commits: Iterable[CommitId]) -> None:
        """Show the cells of some commits anew."""
        for key in {key for commit in commits if (kept := self.outbox.kept(commit)) for key in kept.cells}:
            self.refresh_view(key)

    def _coverage(self, key: CellKey) -> VersionVector:
        return self.cells[key].coverage if key in self.cells else EMPTY

    def _is_covered(self, kept: KeptCommit, wanted: Callable[[Cell], bool] | None) -> bool:
        needed = [key for key in kept.cells if wanted is None or wanted(cell_of_key(key))]
        cells = [self.cells.get(key) for key in needed]
        return all(cell is not None and cell.cursor is not None and kept.id in cell.coverage for cell in cells)

    def _load(self) -> None:
        """Show what is at rest; a cell whose bytes lost their fingerprint is to be fetched anew (rule 15)."""
        for key, cell in list(self.cells.items()):
            base = self.base_evidence(key)
            if fingerprint(base, key) == cell.fingerprint:
                self.refresh_view(key, base=base)
            else:
                log.error("cell %s at rest is not what it was; asking for it anew", cell_of_key(key))
                self.hold_nothing(key, UNPROVEN)
        for key in self.outbox.cells - self.cells.keys():
            self.refresh_view(key)
