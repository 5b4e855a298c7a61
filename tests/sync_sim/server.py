"""The map server of a simulation: the real service on a store in memory, folding on request."""

from collections.abc import Iterable, Sequence
from random import Random
from typing import Any

from tests.fixtures.client.made import GEOMETRY, MAP, PLAIN
from tests.memory_store.map import MemoryMap
from tests.memory_store.snapshot import MemorySnapshot
from tests.memory_store.store import MemoryStore

from cairn_client.sync.requests import Ask, GetCell, GetCommit, GetIndex, GetMissing, GetUpload, Push, PutCell, PutPart
from cairn_client.sync.responses import FetchedCell
from cairn_map.codec.cell_code import decode_cell
from cairn_map.commits.commit import CommitMeta, split_commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.ids import OPERATOR, CommitId, author_from_text
from cairn_map.commits.version_vector import EMPTY, VersionVector
from cairn_map.epochs.history_map import HistoryMap
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, ConflictError, NotFoundError
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.wire.layer_messages import AddLayer
from cairn_map.wire.messages import CellIndex, CreateMap, MissingRequest, Retract
from cairn_map.wire.relay_peer import SignedCommit
from cairn_server.access.auth import Caller, Role
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.replica_notes import BodyPart
from cairn_server.store.store_rows import MapRow
from cairn_server.sync.asked_cells import asked_of
from cairn_server.sync.handing_over import found_commit

Fingerprints = dict[CellKey, str]


class FoldOnRequest:
    """In the place of the folding thread."""

    def __init__(self, *parts: object, **settings: object) -> None:
        pass

    def is_alive(self) -> bool:
        return True

    def wake(self) -> None:
        pass

    def close(self) -> None:
        pass


class StableBackup:
    """In the place of a setting of time: what the oldest backup holds."""

    def __init__(self, vector: VersionVector = EMPTY) -> None:
        self.vector = vector

    def of(self, snapshot: object) -> VersionVector:
        return self.vector


class SimServer:
    """A server that can be restored and replaced."""

    def __init__(self, layer: MapLayer = PLAIN, *, name: str = MAP) -> None:
        """Make a server of a map, or of a layer of one, which is named MAP.LAYER."""
        self.layer = layer
        self.name = name
        self.settings = Settings()
        self._stable = StableBackup()
        self._backup: dict[str, MemoryMap] = {}
        """The map and its layers, by name; empty: there is no backup."""
        self._evidence: dict[CommitId, tuple[CommitMeta, dict[CellKey, bytes]]] = {}
        """Meta and diff of every commit that was ever here: a server may forget them, a test may not."""
        self.states: dict[Cursor, Fingerprints] = {}
        """What each state that ever was held, by its cursor."""
        self.replace()

    def replace(self) -> None:
        """Another server, with nothing on it, under the same name."""
        self._backup, self._stable.vector = {}, EMPTY
        self._start(MemoryStore())
        self.service.maps.create(MAP, CreateMap(geometry=self.layer.geometry, epoch_s=self.layer.epoch_s))
        _, is_layer, layer = self.name.partition(".")
        if is_layer:
            request = AddLayer(name=layer, geometry=self.layer.geometry, epoch_s=self.layer.epoch_s)
            self.service.sync.layers.add(self._store.map(MAP), request, by=Caller(Role.ADMIN))
        self._note_state()

    def restart(self) -> None:
        """Stop and start on the same store."""
        self._start(self._store)

    def back_up(self) -> None:
        """Make a backup, and throw older ones away: what it holds is stable."""
        self._backup = {row.name: self._store._maps.shared(row) for row in self._store.maps()}
        state = self._backup[self.name]
        self._stable.vector = MemorySnapshot(state).vector_at(state.head.seq)

    def restore(self) -> None:
        """Put the backup in the place of the store, and start on it."""
        if self._backup:
            self.restore_under_readers()
            self._start(self._store)

    def restore_under_readers(self) -> None:
        """Put the backup in the place of the store while the server goes on, as a failover to an old copy does."""
        if self._backup:
            self._put_maps(self._backup)

    def trust(self, keys: str) -> None:
        """Obey the operators of servers with these keys."""
        self.settings = self.service.settings.model_copy(update={"trusted_servers": keys})
        self.service.settings = self.service.sync.pushes._settings = self.settings

    def copy_of(self, other: "SimServer") -> None:
        """Another server in this one's place, that starts from a backup of a third."""
        self._backup, self._stable.vector = {}, EMPTY
        states = {row.name: other._store._maps.shared(row) for row in other._store.maps()}
        self._start(MemoryStore())
        self._put_maps(states)
        self._evidence |= other._evidence

    def _put_maps(self, states: dict[str, MemoryMap]) -> None:
        """Put these maps in the place of all that the store has."""
        with self._store._maps.locked() as maps:
            maps.clear()
            maps.update({name: state.copied() for name, state in states.items()})
            # Numbers are given once, also of maps that are lost.
            self._store._maps.made = max([self._store._maps.made, *(state.row.number for state in states.values())])

    def hand_over(self, commit: SignedCommit, *, by: Caller) -> None:
        """A relay brings a commit."""
        self.service.sync.pushes.keep(self.row, by, str(commit.id), commit.data, signatures=commit.signatures)
        meta, cells = split_commit(commit.data)
        self._evidence[commit.id] = meta, cells

    @property
    def backed_up(self) -> VersionVector:
        """What its oldest backup holds."""
        return self._stable.vector

    def answer(self, robot: str, ask: Ask[Any]) -> Any:
        """What the service says to a request; of `GetMissing` the reply's bytes.

        Raises:
            CairnError: as the service does.
        """
        service, row = self.service, self.row
        match ask:
            case Push(commit, seal, signatures):
                beside = {"seal": seal, "signatures": signatures}
                service.sync.pushes.keep(row, Caller(Role.ROBOT, robot), str(commit.id), commit.data, **beside)
                self._evidence[commit.id] = commit.meta, commit.cells
                return None
            case GetUpload(commit_id, digest):
                return service.sync.uploads.state(row, Caller(Role.ROBOT, robot), str(commit_id), digest)
            case PutPart(commit_id, digest, total, offset, data, signatures):
                part = BodyPart(digest, total, offset, data)
                upload, _ = service.sync.uploads.add(
                    row, Caller(Role.ROBOT, robot), str(commit_id), part, signatures=signatures
                )
                kept = service.store.commit(row, commit_id)
                if kept is not None and not kept.gone:  # perhaps under an id that was another server's
                    meta, cells = split_commit(found_commit(service.store, row, str(commit_id)).data)
                    self._evidence[commit_id] = meta, cells
                return upload
            case GetCommit(commit_id):
                found = found_commit(service.store, row, str(commit_id))
                return found.data, found.seal
            case GetMissing(request):
                sent = MissingRequest.model_validate_json(request.model_dump_json())
                return b"".join(service.sync.replies.missing(row, robot, asked_of(sent)).parts())
            case GetIndex(author, held=held):
                since = held.to if held else None
                index = service.sync.replies.cell_index(row, author, since=since)
                found = CellIndex.model_validate_json(index.model_dump_json())
                return found.model_copy(update={"header": found.header.whole(held, since=since)})
            case GetCell(cell, etag):
                stored, head = service.cells.sound(row, cell_key(cell))
                if stored is None:
                    raise NotFoundError("no_cell", f"cell {cell} was never seen")
                found_etag = f'"{stored.digest.hex()}"'
                body = None if etag == found_etag else stored.body
                return FetchedCell(body, found_etag, head.cursor, head.vector, stored.fingerprint)
            case PutCell(cell, body):
                return service.cells.heal(row, cell_key(cell), body)
        raise TypeError(ask)

    def fold(self, limit: int) -> None:
        """Fold some of what waits."""
        fold_pending(self._store, self.row, self._cache, limit=limit)
        self._note_state()

    def fold_all(self) -> None:
        """Fold until nothing waits, and no retract is under way."""
        while fold_pending(self._store, self.row, self._cache, limit=1000):
            self._note_state()

    def retract(self, targets: Sequence[str]) -> None:
        """An operator takes out commits that may or may not have come."""
        try:
            self.service.sync.retracts.retract(self.row, Retract(commits=list(targets)), by=Caller(Role.ADMIN))
        except ConflictError as exc:
            assert exc.kind == "evidence_gone"
        except BadInputError as exc:
            assert exc.kind == "not_retractable"

    def admit_all(self) -> None:
        """An operator says that all robots which were refused for their key are those that they say."""
        admissions = self.service.sync.admissions
        for robot in admissions.list(self.row).asking:
            admissions.admit(self.row, author_from_text(robot.author), by=Caller(Role.OPERATOR))

    def forget_evidence(self) -> None:
        """Drop the evidence of all that was folded."""
        self._store.forget_evidence(self.row, before_s=float("inf"), limit=1000)

    def commits(self) -> dict[CommitId, str]:
        """Every commit of robots that is here, and its note."""
        with self._store._maps.reading(self.row) as state:
            here = [commit for commit in state.commits if commit.author.robot != OPERATOR]
        return {commit: self._evidence[commit][0].note for commit in here}

    def shas(self) -> dict[CommitId, str]:
        """Every commit that is here, and its SHA-256."""
        with self._store._maps.reading(self.row) as state:
            return {commit: kept.new.sha.hex() for commit, kept in state.commits.items()}

    def retracted(self) -> set[CommitId]:
        """What operators took out, once it was folded."""
        with self._store._maps.reading(self.row) as state:
            kept = [kept for commit, kept in state.commits.items() if commit.author.robot == OPERATOR]
            return {target for commit in kept for target in commit.new.retracts}

    def is_retracted(self, commit: CommitId) -> bool:
        """Whether it is taken out, or will be when it comes."""
        return self._store.is_retracted(self.row, commit)

    def sum_of_commits(self) -> HistoryMap:
        """The map as its definition says: all commits that are not retracted, each in the row of its epoch."""
        total = HistoryMap(self.layer)
        for commit in self.commits():
            if not self.is_retracted(commit):
                meta, cells = self._evidence[commit]
                total.merge({key: decode_cell(body).evidence for key, body in cells.items()}, epoch=meta.row)
        return total

    def cells(self) -> dict[CellKey, tuple[bytes, str]]:
        """Digest and fingerprint of each cell that holds evidence."""
        with self._store.snapshot(self.row) as snapshot:
            return {row.key: (row.digest, row.fingerprint.hex()) for row in snapshot.cells() if row.voxels}

    def close(self) -> None:
        """End its threads."""
        self.service.close()

    @property
    def cursor(self) -> Cursor:
        """Where its log ends."""
        with self._store.snapshot(self.row) as snapshot:
            return snapshot.head

    @property
    def row(self) -> MapRow:
        """The map, or the layer."""
        return self._store.map(self.name)

    def _start(self, store: MemoryStore) -> None:
        self._store = store
        self.service = Service(store, self.settings)
        self.service.sync.replies._stable = self._stable  # type: ignore[assignment]
        self._cache = CellCache(self.layer.geometry)

    def _note_state(self) -> None:
        with self._store.snapshot(self.row) as snapshot:
            self.states[snapshot.head] = {row.key: row.fingerprint.hex() for row in snapshot.cells()}


def with_more(first: str, others: Iterable[str], chance: Random) -> tuple[str, ...]:
    """An id, and up to two more of others."""
    left = sorted({*others} - {first})
    return first, *chance.sample(left, min(len(left), chance.randrange(3)))


def meta_of(commit: CommitId, *, note: str, retracts: tuple[str, ...]) -> CommitMeta:
    """What a simulated robot says of its commit."""
    return CommitMeta(id=str(commit), geometry=GEOMETRY.digest().hex(), retracts=retracts, note=note)
