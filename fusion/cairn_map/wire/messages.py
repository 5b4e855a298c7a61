"""JSON messages between client and server, as models that validate on reading (PROTOCOL.md is the norm).

Fields that hold cursors, fingerprints or version vectors carry their text forms; the properties parse them. The
messages of tokens and the audit log are in `access_messages`, those of live streams in `live_events`.
"""

from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, FailFast, Field, ValidationError, model_validator

from cairn_map.commits.commit import ScanPose
from cairn_map.commits.cursor import Cursor, cursor_from_text
from cairn_map.commits.ids import NUMBER_LIMIT, commit_id_from_text
from cairn_map.commits.version_vector import AUTHORS_MAX, VersionVector, version_vector_from_json
from cairn_map.epochs.layer import EpochLength, MapLayer
from cairn_map.errors import DamagedDataError, first_error
from cairn_map.evidence.fingerprint import Fingerprint, fingerprint_from_hex
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.utc_times import UtcText, UtcTexts

INDEX_PAGE = 1000
"""Entries of a page of which the asker says nothing."""
INDEX_PAGE_MAX = 10_000

Mode = Literal["high-end", "low-end", "viewer"]
Count = Annotated[int, Field(ge=0, lt=1 << 53)]
Seconds = Annotated[float, Field(ge=0, le=1e11, allow_inf_nan=False)]
"""UTC since 1970; to the year 5138."""

Message = TypeVar("Message", bound=BaseModel)
CursorText = Annotated[str, Field(max_length=128)]
FingerprintText = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
ShaText = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
NameText = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
MapNameText = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}(\.[a-z][a-z0-9_]{0,31})?$")]
"""Name of a map, or MAP.LAYER."""
IdText = Annotated[str, Field(max_length=96)]
# Absent, not null or 0, where there are no epochs: programs of before refuse fields that they do not know.
EpochLengthOrNone = Annotated[EpochLength | None, Field(exclude_if=lambda value: value is None)]
SinceOrNone = Annotated[CursorText | Literal["cursor"] | None, Field(exclude_if=lambda value: value is None)]
HistoryBytes = Annotated[Count, Field(exclude_if=lambda value: not value)]
# Fail fast, else a few megabytes of wrong intervals become gigabytes of error messages.
Interval = Annotated[list[int], Field(min_length=2, max_length=2), FailFast()]
VectorJson = Annotated[dict[str, Annotated[list[Interval], FailFast()]], Field(max_length=AUTHORS_MAX)]
Time = Annotated[float, Field(allow_inf_nan=False)]

CURSORS_MAX = 100_000
CellNumbers = Annotated[list[tuple[int, int, int]], Field(max_length=CURSORS_MAX), FailFast()]
CursorGroup = tuple[CursorText | None, CellNumbers]
NAME_CHARACTERS = 24
"""Characters of a commit's id, by which the length of a log entry's note is counted."""
WANTED_MAX = 256
"""Commits that a header wants again."""
DAMAGED_MAX = 256
"""Damaged cells named in one header; the others are named when these are healed."""
SELECTING_PARTS = ("robot", "rig", "pushed_after_s", "pushed_before_s", "captured_after_s", "captured_before_s")
FIELDS_MAX = 64
"""Fields of one object, at most: more than any message here has."""
JSON_VALUES_MAX = 1 << 20
JSON_FIELDS_MAX = 1 << 18
"""Values and fields of one JSON text, counted by its separators: three version vectors of 65 536 robots have fewer."""
QUOTE, COLON = b'":'
NO_SEPARATORS = bytes(set(range(256)) - set(b'"[{,:'))
"""All bytes but quotes and what comes before a value."""


class RobotStatus(BaseModel):
    """Body of `PUT /maps/{map}/branches/{branch}/status`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    time_s: Seconds
    """Time of the status by the robot's clock, UTC seconds since 1970."""
    pose: ScanPose | None = None
    """Pose of the rig in the map, with its standard deviations."""
    mode: Mode | None = None
    waiting: Count = 0
    """Commits that the server has not acknowledged."""
    waiting_bytes: Count = 0
    battery: Annotated[float, Field(ge=0, le=1)] | None = None
    """Charge, 1 = full."""
    note: Annotated[str, Field(max_length=256)] = ""
    """Free text, for people."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _tuple_of(value: object) -> object:
    """A JSON array as a tuple, which strict validation demands of values that a validator saw before."""
    return tuple(value) if isinstance(value, list) else value


class _LongRequest(_Model):
    """A request that may be megabytes long."""

    @model_validator(mode="before")
    @classmethod
    def _has_few_fields(cls, value: object) -> object:
        # Each unknown field is an error of its own: a million of them would take minutes and gigabytes.
        if isinstance(value, dict) and len(value) > FIELDS_MAX:
            raise ValueError(f"{len(value)} fields, at most {FIELDS_MAX} can be known")
        return value


class CreateMap(_Model):
    """Body of `PUT /maps/{map}`."""

    geometry: Geometry = Geometry()
    sensor_model: SensorModel = SensorModel()
    epoch_s: EpochLengthOrNone = None
    """Length of an epoch, seconds; None: one sum for all times."""


class MapInfo(_Model):
    """Facts of one map on a server, or of one of its layers."""

    name: MapNameText
    geometry: Geometry
    sensor_model: SensorModel
    cursor: CursorText
    cells: Count
    size_bytes: Count
    """Sum of the encoded cells."""
    commits: Count
    branches: Count
    box_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    """Lowest and highest corner of the cells that hold evidence; None while the map is empty."""
    server_key: ShaText | None = None
    """Public key of the server's own commits on this map, in hex: the argument of `--trust-server`."""
    epoch_s: EpochLengthOrNone = None
    """Length of an epoch, seconds; None: one sum for all times."""
    history_bytes: HistoryBytes = 0
    """Bytes, of `size_bytes`, of evidence older than the newest epoch of its cell."""

    @property
    def layer(self) -> MapLayer:
        """Definition of the map's evidence: the grid and the length of an epoch."""
        return MapLayer(geometry=self.geometry, epoch_s=self.epoch_s)


class MapSizes(_Model):
    """Answer to `GET /maps/{map}/sizes`: what a map takes on its server, by what it is for."""

    present_bytes: Count
    """Bytes of the cells, of the newest row of each."""
    history_bytes: Count
    """Bytes of the cells' older rows."""
    evidence_bytes: Count
    """Bytes of the commits whose evidence is kept, to be retracted and handed over."""
    log_bytes: Count
    """About the bytes of what is kept of each commit for ever."""
    log_entries: Count


class MapDeleted(_Model):
    """Answer to `DELETE /maps/{map}`."""

    name: MapNameText
    deleted_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """Time of the deletion, UTC seconds since 1970."""


class Register(_Model):
    """Body of `POST /maps/{map}/branches`."""

    robot: NameText
    mode: Literal["high-end", "low-end", "viewer"] = "high-end"
    incarnation: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    sensors: Annotated[list[Annotated[str, Field(max_length=64)]], Field(max_length=64)] = []


class Registered(_Model):
    """Answer to a registration; the token is shown once and kept only as a hash."""

    branch: NameText
    token: Annotated[str, Field(pattern=r"^[!-~]{1,256}$")]
    map: MapInfo


class BranchInfo(_Model):
    """One robot as the server sees it."""

    branch: NameText
    mode: str
    sensors: Annotated[list[str], FailFast()]
    cursor: CursorText | None
    behind: Count | None
    """Log entries folded since the branch's cursor; None before its first fetch."""
    behind_bytes: Count | None = None
    """Bytes of others' commits in these entries; None before its first fetch, or if that was too long ago."""
    incarnation: str = ""
    """Incarnation of its latest registration."""
    last_seen_s: float
    last_seen_utc: UtcText = None
    status: RobotStatus | None = None
    """Its latest status."""
    view_s: float | None = None
    """Time at which its latest picture arrived, by the server's clock; None: there is none."""


class PushReceipt(_Model):
    """Answer to a push: the commit is durable now (`new`), or was before (`known`)."""

    id: IdText
    state: Literal["new", "known"]


class CellCursor(_LongRequest):
    """One cell whose cursor differs from the request's default; None: hold nothing of it."""

    cell: Annotated[tuple[int, int, int], BeforeValidator(_tuple_of)]
    cursor: CursorText | None


class MissingRequest(_LongRequest):
    """Body of `POST /maps/{map}/branches/{branch}/missing`: what the asker holds."""

    author: Annotated[str, Field(max_length=80)] | None = None
    """`robot.incarnation` of the asker, whose own commits a delta leaves out."""
    cursor: CursorText | None = None
    """Cursor of every cell not listed; None: holds nothing."""
    cells: Annotated[list[CellCursor], Field(max_length=CURSORS_MAX), FailFast()] = []
    groups: Annotated[list[CursorGroup], Field(max_length=CURSORS_MAX), FailFast()] = []
    """The same by cursor: those of a reply that was cut have the same one, and it is longer than a cell's number."""
    compare: bool = False
    """Answer every listed cell with a `reset` frame: only its fingerprint."""
    box: tuple[tuple[int, int, int], tuple[int, int, int]] | None = None
    """Lowest and highest cell (inclusive) of the request; None: all."""
    size_bytes_max: Annotated[int, Field(ge=1)] | None = None
    """Bytes of cell frames after which the reply ends with `more`; None: the server's own limit."""
    kinds: Annotated[list[Literal["delta", "state", "full"]], Field(max_length=3), FailFast()] = ["delta", "full"]
    """Kinds of frame that the asker can use now; `full` is always implied."""
    near: tuple[int, int, int] | None = None
    """Frames of the cells next to this one come first, then those farther away; None: the newest everywhere."""
    since: CursorText | Literal["cursor"] | None = None
    """State whose vector the asker holds: the header's then names only what was folded since. `cursor`: that of
    `cursor`; None: it holds none."""
    begun: tuple[tuple[int, int, int], Annotated[int, Field(ge=1)], ShaText] | None = None
    """Cell, bytes of its frame's payload that came before a cut, SHA-256 of them: only the rest is sent."""
    known: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")] | None = None
    """First digits of the SHA-256 of the last reply: if this one would be the same, the answer is 204."""


class ReplyHeader(_Model):
    """First frame of a reply, and head of the cell index: one state of the map, and what a robot may conclude."""

    to: CursorText
    vector: VectorJson
    """Ids folded at or before `to`, and after `since` if that is there."""
    since: SinceOrNone = None
    """`since` of the request, if `vector` begins there; None: `vector` is whole."""
    stable: VectorJson
    """Ids of the asker's robot and of the operator that no restore can lose any more."""
    pending: VectorJson = {}
    """Ids of the same that are durable but not folded yet: they need not be pushed, and count for nothing else. To an
    asker without author: those of some authors, none if nothing is pending."""
    tip: tuple[Annotated[int, Field(ge=0, lt=NUMBER_LIMIT)], ShaText] | None = None
    """Highest folded number of the asker's own incarnation, and its SHA-256."""
    retracts: Annotated[list[IdText], FailFast()] = []
    """The operator's newest retracts that are not yet stable, for older robots: `vector` and `stable` tell all."""
    damaged: Annotated[list[tuple[tuple[int, int, int], FingerprintText]], Field(max_length=DAMAGED_MAX)] = []
    """Cells that the server cannot read any more, and their fingerprints: any robot with an undamaged copy may send
    it."""
    wanted: Annotated[list[IdText], Field(max_length=WANTED_MAX)] = []
    """Commits whose evidence a retract needs and the server forgot: any robot that has one pushes it again."""

    @property
    def to_cursor(self) -> Cursor:
        """`to`, parsed."""
        return cursor_from_text(self.to)

    @property
    def coverage(self) -> VersionVector:
        """`vector` of a header without `since`, parsed."""
        return version_vector_from_json(self.vector)

    @property
    def pending_vector(self) -> VersionVector:
        """`pending`, parsed."""
        return version_vector_from_json(self.pending)

    @property
    def stable_vector(self) -> VersionVector:
        """`stable`, parsed."""
        return version_vector_from_json(self.stable)

    def whole(self, held: "ReplyHeader | None", *, since: str | None) -> "ReplyHeader":
        """Header whose vector is whole: with the ids of the one held, at whose state this one's vector may begin.

        Args:
            held: whole header of the state that the request stated in `since`.
            since: `since` of the request.

        Raises:
            DamagedDataError: kind `bad_message`: it begins at another state.
        """
        if self.since is None:
            return self
        if held is None or self.since != since:
            raise DamagedDataError("bad_message", f"the header's vector begins at {self.since}, which was not stated")
        vector = held.coverage.union(self.coverage)
        return self.model_copy(update={"vector": vector.to_json(), "since": None})

    def check(self) -> None:
        """Parse every text once: for a reader who keeps the header.

        Raises:
            BadInputError: one of them cannot be parsed.
        """
        _ = self.to_cursor, self.coverage, self.pending_vector, self.stable_vector
        for text in (*self.retracts, *self.wanted):
            commit_id_from_text(text)
        for cell, _fingerprint in self.damaged:
            cell_key(cell)


class Done(_Model):
    """Last frame of a whole reply: cells without a frame stand at `to` as they are."""

    to: CursorText
    rest: FingerprintText
    """Sum of the fingerprints of the server's cells that got no frame."""

    @property
    def to_cursor(self) -> Cursor:
        """`to`, parsed."""
        return cursor_from_text(self.to)

    @property
    def rest_fingerprint(self) -> Fingerprint:
        """`rest`, parsed."""
        return fingerprint_from_hex(self.rest)


class More(_Model):
    """Last frame of a reply that reached its size limit: ask again for the rest."""

    to: CursorText


class Retract(_Model):
    """Body of `POST /maps/{map}/retracts`: commits by id, and all commits on the server that match every other part."""

    commits: Annotated[list[IdText], Field(max_length=4096), FailFast()] = []
    robot: NameText | None = None
    rig: ShaText | None = None
    """SHA-256 of the `rig.json` of the commits' rig."""
    pushed_after_s: Time | None = None
    pushed_before_s: Time | None = None
    """Bounds of the time at which the server received the commits, UTC seconds since 1970."""
    captured_after_s: Time | None = None
    captured_before_s: Time | None = None
    """Bounds of the time of a scan of the commits, UTC seconds since 1970."""
    note: Annotated[str, Field(max_length=1024)] = ""
    preview: bool = False
    """True if the answer only lists the commits, and nothing is retracted."""

    @property
    def selects(self) -> bool:
        """True if the request selects commits by their properties, not only by id."""
        return any(getattr(self, part) is not None for part in SELECTING_PARTS)


class Retracted(_Model):
    """Answer to a retract: the retracting commit, None for a preview, and the commits that it names."""

    id: IdText | None
    commits: Annotated[list[IdText], FailFast()]


class LogEntry(_Model):
    """One row of the log: evidence folded in, or taken out again."""

    seq: Count
    kind: Literal["+", "-"]
    id: IdText
    sha: ShaText
    size_bytes: Count
    cells: Count
    captured_s: tuple[float, float] | None
    captured_utc: UtcTexts = None
    retracts: Annotated[list[IdText], FailFast()]
    parent: ShaText | None = None
    seen: CursorText | None = None
    """SHA-256 of the author's commit before it, and the state of the server that the author had when it made it."""
    place_m: tuple[float, float, float] | None = None
    """Place of the rig at the commit's last scan, metres, map frame; None: it has no scans, or is not kept any more."""
    via: str | None = None
    """Name of the token of the relay that handed it over, or of the operator for whom the server made it.

    None: its own robot pushed it.
    """
    note: Annotated[str, Field(max_length=1024)] = ""
    """Note of its author; empty, too, once its evidence is not kept."""
    pushed_s: Annotated[float | None, Field(exclude_if=lambda value: value is None)] = None
    """Time at which this server received the commit, UTC seconds since 1970; None: it is left out."""
    pushed_utc: UtcText = None

    def without_receipt(self) -> Self:
        """The entry as clients of `Cairn-Format` 4 and below know it: they refuse a field that is new to them."""
        return self.model_copy(update={"pushed_s": None})

    @property
    def names(self) -> int:
        """Count of the commits that it names, and of those whose ids would be as long as its note."""
        return len(self.retracts) + len(self.note) // NAME_CHARACTERS


class Problem(BaseModel):
    """RFC 9457 problem; `kind` is cairn's stable code."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    type: str = "about:blank"
    title: str = ""
    status: int = 0
    detail: str = ""
    kind: str = "unknown"


def check_json_size(text: bytes | str) -> None:
    """Refuse JSON of more values or fields than a message may have, before any of them is made.

    A value of two bytes takes some fifty in memory, and a field that no model knows a thousand, as an error of its own.

    Raises:
        DamagedDataError: kind `too_many_values`.
    """
    fields, values = _separators(text if isinstance(text, bytes) else text.encode(errors="replace"))
    if fields > JSON_FIELDS_MAX or values > JSON_VALUES_MAX:
        raise DamagedDataError(
            "too_many_values",
            f"a message has at most {JSON_VALUES_MAX} values and {JSON_FIELDS_MAX} fields, "
            f"got up to {values} and {fields}",
        )


def _separators(text: bytes) -> tuple[int, int]:
    """Colons of a JSON text, and all its separators; those in strings count only while they are harmless."""
    fields = text.count(b":")
    values = fields + sum(map(text.count, (b"[", b"{", b",")))
    if fields <= JSON_FIELDS_MAX and values <= JSON_VALUES_MAX:
        return fields, values
    # A few passes in C, none of which makes an object for each string: a text may have tens of millions.
    if b"\\" in text:
        text = text.replace(rb"\\", b"").replace(rb"\"", b"")
    left = np.frombuffer(text.translate(None, NO_SEPARATORS), np.uint8)
    outside = left[np.bitwise_xor.accumulate(left == QUOTE) == 0]
    separators = outside[outside != QUOTE]
    return int(np.count_nonzero(separators == COLON)), len(separators)


def message_from_json(model: type[Message], data: bytes | str) -> Message:
    """A message of a model, validated.

    Raises:
        DamagedDataError: not JSON, or a field is missing, unknown or out of range.
    """
    check_json_size(data)
    try:
        return model.model_validate_json(data, strict=True)
    except ValidationError as exc:
        raise DamagedDataError("bad_message", f"{model.__name__}: {first_error(exc)}") from None


class CellEntry(BaseModel):
    """One row of the cell index."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cell: tuple[int, int, int]
    size_bytes: Count
    digest: ShaText
    lm: Count
    """Log entry that last changed the cell."""
    fingerprint: FingerprintText
    voxels: Count
    hottest_k: float | None = None
    """Mean temperature of its hottest voxel, kelvin; None: it has none, or the server does not know it, or was not
    asked for it, because older robots refuse fields that they do not know."""
    held_lm: Count | None = None
    """Newest log entry whose evidence is still in the cell: `lm`, unless that took some out. None: the cell is empty,
    or the server does not know it any more, or was not asked for it."""


class CellIndex(BaseModel):
    """Answer to `GET /maps/{map}/main/cells`: a page of the index, taken from one state of the map."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    header: ReplyHeader
    cells: Annotated[list[CellEntry], FailFast()]


class Upload(BaseModel):
    """State of the upload of a commit in parts: the answer to each part, and to a query."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size_bytes: Annotated[int, Field(ge=0)]
    """Bytes of the body that have arrived, from its first one on: the next part begins there."""
    sha: ShaText | None = None
    """SHA-256 of the commit that is kept for good under this id; None: none yet."""
