"""A robot's map without the network: what it made itself, what it has from the server, and the sum that it sees.

    store    own commits, until no restore can lose them              (SYNC.md rule 12)
    base     per cell the server's state at a cursor, and its coverage: the ids in it
    view     base + the commits in the store that the cell's coverage lacks     (rule 7)

Everything durable changes in one local transaction; everything is called under one lock.
"""

import logging
import threading
from collections.abc import Iterable, Mapping

from cairn_client.replica_store import BaseCell, KeptCommit, ReplicaStore
from cairn_map.brick_cell import sum_evidence
from cairn_map.cell_code import decode_cell, encode_cell
from cairn_map.commit import Commit, CommitMeta, make_commit, renamed_commit, split_commit
from cairn_map.cursor import Cursor, cursor_from_text
from cairn_map.errors import BadInputError
from cairn_map.evidence import Evidence, empty_evidence
from cairn_map.evidence_map import EvidenceMap
from cairn_map.fingerprint import ZERO, fingerprint
from cairn_map.grid import CellKey, Geometry
from cairn_map.ids import Author, CommitId, Incarnation, RobotName, new_incarnation
from cairn_map.messages import ReplyHeader, message_from_json
from cairn_map.version_vector import EMPTY, VersionVector

log = logging.getLogger(__name__)


class Replica:
    """One robot's durable state and its view of the map."""

    def __init__(self, store: ReplicaStore, *, robot: RobotName, geometry: Geometry) -> None:
        self.lock = threading.RLock()
        self.store = store
        self.geometry = geometry
        self.view = EvidenceMap(geometry)
        self._check_identity(robot, geometry)
        header = self.store.get("header")
        self.header: ReplyHeader | None = message_from_json(ReplyHeader, header) if header else None
        cursor = self.store.get("default_cursor")
        self.default_cursor: Cursor | None = cursor_from_text(cursor) if cursor else None
        self.cells: dict[CellKey, BaseCell] = self.store.cells()
        self.commits: dict[CommitId, KeptCommit] = {kept.id: kept for kept in self.store.commits()}
        self._acked_since_header: set[CommitId] = set()
        for key in self.cells.keys() | {key for kept in self._with_data() for key in kept.cells}:
            self.refresh_view(key)

    @property
    def author(self) -> Author:
        """The robot in its present incarnation."""
        return Author(self._robot, self._incarnation)

    def commit(self, diff: Mapping[CellKey, Evidence], meta: CommitMeta | None = None) -> Commit:
        """Keep evidence as the next commit, durably, and see it in the view.

        Args:
            diff: packed evidence by cell.
            meta: what to say about it; id, geometry, parent and cursor are filled in here.
        """
        with self.lock:
            n = int(self.store.get("next_n") or 0)
            known = {
                "id": str(CommitId(self.author, n)),
                "geometry": self.geometry.digest().hex(),
                "parent": self.store.get("tip_sha"),
                "seen": str(self.default_cursor) if self.default_cursor else None,
            }
            meta = meta.model_copy(update=known) if meta else CommitMeta.model_validate(known)
            commit = make_commit(meta, diff, self.geometry)
            with self.store.transaction():
                self.store.add_commit(commit)
                self._set_next(n + 1, commit)
            self.commits[commit.id] = KeptCommit(commit.id, commit.sha, False, tuple(sorted(commit.cells)), True)
            self.view.merge({key: diff[key] for key in commit.cells})
            return commit

    def push_set(self) -> list[CommitId]:
        """Commits that the server may lack, oldest first.

        The store minus what the newest header covers, minus what is on the server's desk or was acknowledged
        since. A commit that was never acknowledged is pushed even if its id is covered: after a roll-back of this
        robot's disk another commit may have that id (rule 13).
        """
        with self.lock:
            covered = self.header.coverage if self.header else EMPTY
            pending = self.header.pending_vector if self.header else EMPTY
            return [
                kept.id
                for kept in self._with_data()
                if kept.id not in self._acked_since_header
                and not (kept.acked and (kept.id in covered or kept.id in pending))
            ]

    def commit_data(self, commit: CommitId) -> bytes | None:
        """Bytes of a kept commit."""
        with self.lock:
            return self.store.commit_data(commit)

    def acknowledge(self, commit: CommitId) -> None:
        """The server has these bytes for good. It counts for nothing else: only coverage says what a cell holds."""
        with self.lock:
            with self.store.transaction():
                self.store.set_acked(commit)
            kept = self.commits[commit]
            self.commits[commit] = KeptCommit(kept.id, kept.sha, True, kept.cells, kept.has_data)
            self._acked_since_header.add(commit)

    def rename(self, commit: CommitId) -> CommitId:
        """Give a commit whose id is taken on the server a new one, in a new incarnation (rule 13)."""
        with self.lock:
            data = self.store.commit_data(commit)
            if data is None:
                raise BadInputError("no_bytes", f"the bytes of {commit} are not kept any more")
            if commit.author == self.author:
                self.new_incarnation(f"the id {commit} is taken by other bytes")
            n = int(self.store.get("next_n") or 0)
            renamed = renamed_commit(data, commit=CommitId(self.author, n), parent=self.store.get("tip_sha"))
            with self.store.transaction():
                self.store.remove_commit(commit)
                self.store.add_commit(renamed)
                self._set_next(n + 1, renamed)
            del self.commits[commit]
            self.commits[renamed.id] = KeptCommit(renamed.id, renamed.sha, False, tuple(sorted(renamed.cells)), True)
            for key in renamed.cells:
                self.refresh_view(key)
            return renamed.id

    def new_incarnation(self, reason: str) -> None:
        """Number commits anew under a fresh incarnation: this robot's disk was rolled back or lost."""
        with self.lock:
            log.warning("robot %s takes a new incarnation: %s", self._robot, reason)
            self._incarnation = new_incarnation()
            with self.store.transaction():
                self.store.put("incarnation", self._incarnation)
                self._set_next(0, None)

    def take_header(self, header: ReplyHeader) -> None:
        """Note the newest state that the server told of, and whether it knows of commits that this disk forgot."""
        with self.lock:
            with self.store.transaction():
                self.store.put("header", header.model_dump_json())
            self.header = header
            self._acked_since_header.clear()
            if header.tip is not None:
                n, sha = header.tip
                own = self.commits.get(CommitId(self.author, n))
                if n >= int(self.store.get("next_n") or 0) or (own is not None and own.sha.hex() != sha):
                    self.new_incarnation(f"the server has commit {n} of it with bytes that are not here")

    def base_evidence(self, key: CellKey) -> Evidence:
        """The server's evidence of a cell as it is held here."""
        body = self.store.body(key)
        return decode_cell(body).evidence if body else empty_evidence(self.geometry)

    def own_evidence(self, key: CellKey, commits: Iterable[CommitId]) -> list[Evidence] | None:
        """What commits in the store say about a cell; None if the bytes of one are not kept any more."""
        found: list[Evidence] = []
        for commit in commits:
            kept = self.commits.get(commit)
            if kept is not None and key not in kept.cells:
                continue
            data = self.store.commit_data(commit) if kept else None
            if data is None:
                return None
            found.append(decode_cell(split_commit(data)[1][key]).evidence)
        return found

    def hold(self, key: CellKey, cell: BaseCell, evidence: Evidence, *, body: bytes | None = None) -> None:
        """Make a cell's base this evidence, with its cursor and coverage, in one transaction, and show it."""
        with self.store.transaction():
            self.store.put_cell(key, cell, body=body or encode_cell(key, evidence, self.geometry).data)
        self.cells[key] = cell
        self.refresh_view(key, base=evidence)

    def move(self, keys: Iterable[CellKey], *, to: Cursor | None, coverage: VersionVector | None) -> None:
        """Give held cells another cursor, and coverage unless None; their evidence stays."""
        with self.store.transaction():
            for key in keys:
                cell = self.cells[key]
                moved = BaseCell(to, cell.coverage if coverage is None else coverage, cell.fingerprint, cell.etag)
                self.store.move_cell(key, moved)
                self.cells[key] = moved
            self.store.drop_unused_coverage()

    def set_default_cursor(self, cursor: Cursor | None) -> None:
        """The cursor of every cell that is not held."""
        with self.store.transaction():
            self.store.put("default_cursor", str(cursor) if cursor else None)
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
            self.cells.clear()
            self.commits = {kept.id: kept for kept in self.store.commits()}
            self._acked_since_header.clear()
            self.view.clear()
            for key in {key for kept in self._with_data() for key in kept.cells}:
                self.refresh_view(key)

    def forget_stable_commits(self) -> int:
        """Drop the bytes of commits that are stable and in every held cell they touch (rule 12); how many."""
        with self.lock:
            stable = self.header.stable_vector if self.header else EMPTY
            gone = [kept for kept in self._with_data() if kept.id in stable and self._is_covered(kept)]
            if gone:
                with self.store.transaction():
                    self.store.forget_data(kept.id for kept in gone)
                for kept in gone:
                    self.commits[kept.id] = KeptCommit(kept.id, kept.sha, kept.acked, kept.cells, False)
            return len(gone)

    def refresh_view(self, key: CellKey, *, base: Evidence | None = None) -> None:
        """Make the view of a cell its base plus the commits that the base lacks."""
        cell = self.cells.get(key)
        coverage = cell.coverage if cell else EMPTY
        uncovered = [kept.id for kept in self._with_data() if key in kept.cells and kept.id not in coverage]
        own = self.own_evidence(key, uncovered) or []
        if base is None:
            base = self.base_evidence(key)
        self.view.replace(key, sum_evidence([base, *own], self.geometry))

    def close(self) -> None:
        """Close the file."""
        with self.lock:
            self.store.close()

    def _with_data(self) -> list[KeptCommit]:
        return [kept for kept in self.commits.values() if kept.has_data]

    def _is_covered(self, kept: KeptCommit) -> bool:
        cells = [self.cells[key] for key in kept.cells if key in self.cells]
        return all(cell.cursor is not None and kept.id in cell.coverage for cell in cells)

    def _set_next(self, n: int, tip: Commit | None) -> None:
        self.store.put("next_n", str(n))
        self.store.put("tip_sha", tip.sha.hex() if tip else None)

    def _check_identity(self, robot: RobotName, geometry: Geometry) -> None:
        text = geometry.model_dump_json()
        with self.store.transaction():
            for key, value in (("robot", robot), ("geometry", text)):
                known = self.store.get(key)
                if known is not None and known != value:
                    raise BadInputError(
                        "other_replica", f"this folder belongs to another {key}: {known[:120]}; choose another folder"
                    )
                self.store.put(key, value)
            if self.store.get("incarnation") is None:
                self.store.put("incarnation", new_incarnation())
        self._robot = robot
        self._incarnation = Incarnation(self.store.get("incarnation") or "")


def base_cell(key: CellKey, evidence: Evidence, *, cursor: Cursor | None, coverage: VersionVector) -> BaseCell:
    """A base for evidence, with its fingerprint."""
    return BaseCell(cursor, coverage, fingerprint(evidence, key) if len(evidence) else ZERO)
