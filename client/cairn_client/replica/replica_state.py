"""Texts that a robot's folder remembers between two runs, by key, with their types.

    ReplicaState    whose folder it is, its place on the server, its limits: one text for each field
    RobotKeys       keys that sign the robot's commits: one text for each incarnation
    Successors      commits that stand for others: one text for each commit that was taken out
    AmendRecords    poses and rig of amends: one text for each amend

A value that is set is durable on return, or with the transaction that this thread has open. The commits and cells have
tables of their own in the store.
"""

import base64
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic, Self, TypeVar, overload

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, TypeAdapter

from cairn_client.replica.limits import Limits
from cairn_client.replica.replica_schema import translate_damage
from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import CommitId, Incarnation, RobotName, commit_id_from_text
from cairn_map.commits.signature import SIGNATURES_MAX, Signature, SigningKey, signatures_to_text
from cairn_map.commits.version_vector import VersionVector, vector_text, version_vector_from_json
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.messages import Mode, ReplyHeader, message_from_json

T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)

OPEN = "open"
"""Text under the key "door" of a robot that registered without a token."""


class Contact(BaseModel):
    """Last contact with the server, and the failures since then."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    last_s: float | None = None
    """End of the last whole round, UTC; None if there was none yet."""
    failed_s: float | None = None
    """Time of the first failure since the last whole round, UTC; None if there was none."""
    kind: str = ""
    """Error kind of the last failure since the last whole round; empty if there was none."""
    reason: str = ""
    """Message of the last failure since the last whole round; empty if there was none."""


CLOCKS_PART = 1e-4
"""Seconds by which two clocks may part in a second: ten times what quartz does."""


class LearntOffset(BaseModel):
    """Lead of the server's time over the robot's steady clock, as it was learnt last."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    boot: str
    """Boot of the machine with which the steady clock began."""
    offset_s: float
    error_s: float
    """Bound of its error when it was learnt."""
    steady_s: float
    """Steady time at which it was learnt."""

    def error_at(self, steady_s: float) -> float:
        """Bound of its error at a steady time."""
        return self.error_s + CLOCKS_PART * max(0.0, steady_s - self.steady_s)


class CellCube(BaseModel):
    """Cube of cells around a robot: those of the server that a full robot keeps."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    centre: tuple[int, int, int]
    """The cell in the middle."""
    radius: int
    """Cells from the centre to each face; 0 is the centre alone."""


class Field(Generic[T]):
    """One remembered value: a descriptor that reads and writes the text under a key."""

    def __init__(self, key: str, decode: Callable[[str], T], encode: Callable[[T], str | None] = str) -> None:
        """Args: encode: the text of a value; None for a value that is remembered as no text."""
        self.key = key
        self.decode = decode
        self.encode = encode

    @overload
    def __get__(self, state: None, owner: type[Any]) -> Self: ...
    @overload
    def __get__(self, state: "ReplicaState", owner: type[Any]) -> T | None: ...
    def __get__(self, state: "ReplicaState | None", owner: type[Any]) -> Self | T | None:
        return self if state is None else self.read(state.store.get, state.store.file)

    def __set__(self, state: "ReplicaState", value: T | None) -> None:
        state.store.put(self.key, None if value is None else self.encode(value))

    def read(self, get: Callable[[str], str | None], file: Path) -> T | None:
        """The value among texts by key, as `ReplicaStore.get` or a dict's `get` returns them; None if it is not set.

        Raises:
            DamagedDataError: kind `damaged_store`: the text is no such value; the message names the file.
        """
        text = get(self.key)
        if text is None:
            return None
        with translate_damage(file):
            return self.decode(text)


def _model_field(key: str, model: type[Model]) -> Field[Model]:
    return Field(key, model.model_validate_json, lambda value: value.model_dump_json())


class ReplicaState:
    """Typed record of what a robot's folder remembers; each attribute is one stored text."""

    robot = Field("robot", RobotName)
    """Name of the robot whose folder it is."""
    map_name = Field("map", str)
    """Name of the map on its server."""
    geometry = _model_field("geometry", Geometry)
    """Grid of the map."""
    epoch_s = Field("epoch_s", int)
    """Length of the map's epochs, seconds; None: it has none."""
    url: Field[str] = Field("url", str)
    """Map on its server, `http://HOST:PORT/maps/NAME`."""
    mode: Field[Mode] = Field("mode", TypeAdapter[Mode](Mode).validate_python)
    """Mode in which the robot was opened last."""
    limits = Field("limits", lambda text: Limits(**json.loads(text)), lambda limits: json.dumps(asdict(limits)))
    """Limits that were given last."""
    kept_cube = _model_field("room", CellCube)
    """Cells of the server that the robot keeps; None while the whole map fits."""
    sensor_model = _model_field("sensor_model", SensorModel)
    """The map's own sensor model; None while no server has stated it."""
    header = Field("header", lambda text: message_from_json(ReplyHeader, text), lambda header: header.model_dump_json())
    """Newest state that the server reported."""
    default_cursor = Field[Cursor]("default_cursor", cursor_from_text)
    """Cursor of every cell that is not held."""
    default_coverage = Field[VersionVector](
        "default_coverage", lambda text: version_vector_from_json(json.loads(text)), vector_text
    )
    """Commits in the server's map at that cursor."""
    token = Field("token", str)
    """Token that a server gave to the robot."""
    token_origin = Field("token_origin", str)
    """Origin of the server that gave the token, `http://base:8750`; None in a folder of an earlier version."""
    may_register_openly = Field("door", lambda text: text == OPEN, lambda is_open: OPEN if is_open else None)
    """True if the robot registered without any token, and so can register again."""
    contact = _model_field("contact", Contact)
    """Last contact with the server, to ten seconds."""
    server_clock = _model_field("server_clock", LearntOffset)
    """The server's time by the robot's steady clock; None if no server has said it."""
    incarnation = Field("incarnation", Incarnation)
    """Incarnation under which the robot numbers its commits."""
    drawn = Field[list[Incarnation]](
        "drawn", TypeAdapter[list[Incarnation]](list[Incarnation]).validate_json, json.dumps
    )
    """Incarnations that were drawn with a key, the oldest first."""
    next_n = Field[int]("next_n", int)
    """Number of the robot's next commit."""
    tip_sha = Field("tip_sha", str)
    """SHA-256, hex, of the robot's last commit; None before the first of an incarnation."""

    def __init__(self, store: ReplicaStore) -> None:
        self.store = store

    @property
    def layer(self) -> MapLayer | None:
        """Grid and epochs of the map; None before they are known."""
        return None if self.geometry is None else MapLayer(geometry=self.geometry, epoch_s=self.epoch_s)

    def identify(self, *, robot: RobotName, map_name: str, layer: MapLayer) -> None:
        """Make the folder this robot's, or check that it is.

        Raises:
            BadInputError: kind `other_replica`: it belongs to another robot, map or grid, or to one of other epochs.
        """
        identity = {
            ReplicaState.robot.key: robot,
            ReplicaState.map_name.key: map_name,
            ReplicaState.geometry.key: layer.geometry.model_dump_json(),
            ReplicaState.epoch_s.key: None if layer.epoch_s is None else str(layer.epoch_s),
        }
        with self.store.transaction():
            is_new = self.robot is None
            for key, value in identity.items():
                known = self.store.get(key)
                if known != value and not (known is None and is_new):
                    raise BadInputError(
                        "other_replica",
                        f"the robot's folder belongs to another {key}: {(known or 'none')[:120]}; "
                        "choose another (--state)",
                    )
                self.store.put(key, value)

    def note_use(self, *, url: str, mode: Mode) -> None:
        """Remember on which map, and in which mode, the robot works."""
        with self.store.transaction():
            self.url = url
            self.mode = mode

    def note_model(self, model: SensorModel) -> None:
        """Remember the sensor model that the server stated, if it is new."""
        if self.map_model() != model:
            self.sensor_model = model

    def map_model(self) -> SensorModel:
        """The map's own sensor model; the default one while no server has stated it."""
        return self.sensor_model or SensorModel()


class RobotKeys:
    """Keys by which a robot signs its commits: one for each of its incarnations, in its file next to its token.

    A key and the incarnation that follows from it are drawn together. Older ones are kept: a commit of an older
    incarnation may still wait, or be taken back.
    """

    def __init__(self, state: ReplicaState, robot: RobotName) -> None:
        self._state = state
        self._store = state.store
        self._robot = robot

    def has(self, incarnation: Incarnation) -> bool:
        """True if this incarnation's commits can be signed."""
        return self._key(incarnation) is not None

    def draw(self) -> Incarnation:
        """Draw a new key, in a transaction of the caller's; the incarnation that follows from it."""
        key = SigningKey.drawn()
        self._state.drawn = [*(self._state.drawn or []), key.incarnation]
        self._store.put(_signing_key(key.incarnation), key.seed.hex())
        return key.incarnation

    def vouching(self) -> dict[Incarnation, bytes]:
        """Seeds of the keys that vouch for the robot's name, by the incarnation that follows from each."""
        older, drawn = self._drawn()
        return {key.incarnation: key.seed for key in self._keys([*older, *drawn[:1]])}

    def borrow(self, seeds: Mapping[Incarnation, bytes]) -> None:
        """Sign with these keys, too: those of the same robot in another folder, which drew them for itself."""
        own = self._state.drawn or []
        with self._store.transaction():
            for incarnation, seed in seeds.items():
                if incarnation not in own:
                    self._store.put(_signing_key(incarnation), seed.hex())

    def _drawn(self) -> tuple[list[Incarnation], list[Incarnation]]:
        """Incarnations with a key from before a list of them was kept, in no order; and that list, oldest first."""
        drawn = self._state.drawn or []
        found = [Incarnation(text.removeprefix(_signing_key(""))) for text in self._store.keys(_signing_key(""))]
        return [incarnation for incarnation in found if incarnation not in drawn], drawn

    def _keys(self, incarnations: list[Incarnation]) -> list[SigningKey]:
        """Keys of these incarnations that are here: as many as may sign."""
        known = (self._key(incarnation) for incarnation in dict.fromkeys(incarnations))
        return [key for key in known if key is not None][:SIGNATURES_MAX]

    def signatures(self, commit: Commit) -> str | None:
        """Signatures on an own commit; None without a key.

        By its incarnation, by those whose commits it takes out, and by the robot's first and present keys: whichever a
        server knows vouches for the author, wherever the commit goes.
        """
        spoken_for = dict.fromkeys([commit.id.author, *(target.author for target in commit.meta.retracted_ids)])
        own = [author.incarnation for author in spoken_for if author.robot == self._robot]
        older, drawn = self._drawn()
        keys = self._keys([*own, *older, *drawn[:1], *drawn[-1:]])
        if commit.id.author.robot != self._robot or not self.has(commit.id.author.incarnation):
            return None
        map_name = self._state.map_name or ""
        return signatures_to_text([key.sign(map_name, commit.sha) for key in keys])

    def sign_bytes(self, incarnation: Incarnation, message: bytes) -> tuple[Signature, ...]:
        """Signatures on a message by the key of an incarnation, and by the robot's other keys, the oldest first."""
        older, drawn = self._drawn()
        return tuple(key.sign_bytes(message) for key in self._keys([incarnation, *older, *drawn]))

    def _key(self, incarnation: Incarnation) -> SigningKey | None:
        seed = self._store.get(_signing_key(incarnation))
        with translate_damage(self._store.file):
            return SigningKey(bytes.fromhex(seed)) if seed else None


def _signing_key(incarnation: str) -> str:
    return f"signing_key.{incarnation}"


class Successors:
    """Successors of a robot's commits: the first commit that names a commit stands for it, for ever.

        C  <- M1  <- M2         M1 amends C, M2 amends M1: M2 is what stands for C now

    A retract takes effect once (SYNC.md rule 11), so a later commit that names the same one changes nothing. The texts
    are part of the transaction that keeps the naming commit; they are read again after it, so that one that failed
    leaves no trace.
    """

    def __init__(self, store: ReplicaStore) -> None:
        self._store = store
        self._of: dict[CommitId, CommitId] = {}

    def of(self, commit: CommitId) -> CommitId | None:
        """The commit that took a commit out, of those that were read; None if there is none."""
        return self._of.get(commit)

    def latest(self, commit: CommitId) -> CommitId:
        """The commit that stands for a commit now; itself if none took it out.

        Raises:
            DamagedDataError: kind `damaged_store`: the successors form a circle.
        """
        seen = {commit}
        while (successor := self._stored(commit)) is not None:
            if successor in seen:
                raise DamagedDataError(
                    "damaged_store", f"{self._store.file} is damaged: commit {commit} comes after itself"
                )
            seen.add(successor)
            commit = successor
        return commit

    def read(self, commit: CommitId) -> None:
        """Read from the store which commit took a commit out."""
        successor = self._stored(commit)
        if successor is not None:
            self._of[commit] = successor

    def put(self, commit: CommitId, by: CommitId) -> None:
        """Within a transaction, note that `by` takes a commit out, unless another did before."""
        if self._stored(commit) is None:
            self._store.put(_successor_key(commit), str(by))

    def rename(self, old: CommitId, new: CommitId, *, takes_out: tuple[CommitId, ...]) -> None:
        """Within a transaction, note that a commit, which takes out these, gets a new id; its successor stays."""
        by = self._stored(old)
        self._store.put(_successor_key(old), str(new) if by is None else str(by))
        self._store.put(_successor_key(new), None if by is None else str(by))
        for target in takes_out:
            if self._stored(target) == old:
                self._store.put(_successor_key(target), str(new))

    def _stored(self, commit: CommitId) -> CommitId | None:
        text = self._store.get(_successor_key(commit))
        with translate_damage(self._store.file):
            return None if text is None else commit_id_from_text(text)


def _successor_key(commit: CommitId) -> str:
    return f"successor:{commit}"


class AmendRecord(BaseModel):
    """Facts of an amend that outlive its bytes: the commit whose place it took, and where its evidence comes from."""

    model_config = ConfigDict(frozen=True)

    of: str
    """Commit whose place it took: its scans are those of the amend."""
    rig: str | None = None
    """Digest of the rig, hex."""
    integrator: str = ""
    scans: int = 0
    """Number of its scans."""
    poses: str | None = None
    """Poses of its scans, row by row in little-endian float64, base64; None: those that were observed."""

    @property
    def T_map_rig(self) -> npt.NDArray[np.float64] | None:
        """(N, 4, 4) poses of its scans, bit for bit, where a commit states quaternions; None: those observed.

        Raises:
            DamagedDataError: kind `damaged_store`: they are no poses.
        """
        if self.poses is None:
            return None
        try:
            return np.frombuffer(base64.b64decode(self.poses), "<f8").reshape(self.scans, 4, 4).astype(np.float64)
        except ValueError as exc:
            raise DamagedDataError("damaged_store", f"the poses of the amend of {self.of} are damaged: {exc}") from exc


def poses_to_text(T_map_rig: npt.NDArray[np.float64]) -> str:
    """Poses as an `AmendRecord` keeps them."""
    return base64.b64encode(T_map_rig.astype("<f8").tobytes()).decode()


class AmendRecords:
    """Records of a robot's amends, in the transactions that keep the amends."""

    def __init__(self, store: ReplicaStore) -> None:
        self._store = store

    def of(self, commit: CommitId) -> AmendRecord | None:
        """The record of an amend; None of any other commit, and of one from before records were kept."""
        text = self._store.get(_amend_key(commit))
        with translate_damage(self._store.file):
            return None if text is None else AmendRecord.model_validate_json(text)

    def put(self, commit: CommitId, record: AmendRecord) -> None:
        """Within a transaction, note what an amend is; the poses of the amend that it replaces go."""
        self._store.put(_amend_key(commit), record.model_dump_json())
        older = commit_id_from_text(record.of)
        replaced = self.of(older)
        if replaced is not None:
            self._store.put(_amend_key(older), replaced.model_copy(update={"poses": None}).model_dump_json())

    def rename(self, old: CommitId, new: CommitId) -> None:
        """Within a transaction, note that an amend, if it is one, gets a new id."""
        self._store.put(_amend_key(new), self._store.get(_amend_key(old)))

    def leads(self, commit: CommitId, original: CommitId) -> bool:
        """True if a commit came from an original by amends alone, so that the original's scans are its own."""
        seen: set[CommitId] = set()
        while commit != original:
            record = self.of(commit)
            if record is None or commit in seen:
                return False
            seen.add(commit)
            commit = commit_id_from_text(record.of)
        return True


def _amend_key(commit: CommitId) -> str:
    return f"amend:{commit}"
