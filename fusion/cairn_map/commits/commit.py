"""Commits: one measurement's evidence under an id, with all facts that are needed to find and undo it later.

    "CRCM" | version u8 | meta length u32 | meta (JSON) | cell count u32 | per cell: length u32, cell bytes

In version 2, of maps with epochs, the meta names the layers and the epoch, and each cell begins with a u8, the number
of its layer. A cell of a commit has one row, that of the epoch, and so is a cell file of version 1 in both. A commit
of version 3 has marks in its meta, and no cells (`mark`); one of version 4 defines a further layer of its map, and is
that layer's beginning (`epochs.layer`).

Its SHA-256 is taken over the meta bytes and the cells' canonical digests, so that cells may be recompressed without
changing it. A retract is a commit without cells that names others; an amend is one with both. FORMAT.md is the norm.
"""

import hashlib
import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError, model_validator

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cells
from cairn_map.codec.octree.cell_head import decode_head
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.commits.mark import AMENDED_MAX, MARKS_MAX, Mark, MarkKey
from cairn_map.epochs.epoch import BASE, EPOCH_MAX, Epoch
from cairn_map.epochs.layer import Hex32, LayerDefinition, LayerIdentity, MapLayer
from cairn_map.errors import BadInputError, DamagedDataError, first_error
from cairn_map.evidence.evidence import Evidence, every_sum_has_weight
from cairn_map.evidence.grid import CellKey, Geometry

MAGIC = b"CRCM"
SUM_VERSION, EPOCH_VERSION, MARK_VERSION, LAYER_VERSION = 1, 2, 3, 4
"""Versions of a commit's bytes: of maps with one sum for all times, of maps with epochs, and on any map of commits with
marks, and of such as define a layer."""
EVICTION_FIELDS = frozenset({"keep_epochs", "weight_max"})
"""Fields of a layer that are reserved for maps that let old rows go."""
NEWER = ("extra_forbidden", "literal_error")
"""Kinds of errors in the definition of a layer by which a newer program's is known."""
LAYERS_MAX = 1
"""Layers of a commit that this reader knows; the format has room for 16."""
CELL_PREFIX = {
    SUM_VERSION: struct.Struct("<I"),
    EPOCH_VERSION: struct.Struct("<BI"),
    MARK_VERSION: struct.Struct("<I"),
    LAYER_VERSION: struct.Struct("<I"),
}
HEAD = struct.Struct("<4sBI")
META_BYTES_MAX = 1 << 20
CELLS_MAX = 4096
COMMIT_BYTES_MAX = 64 << 20
"""Bytes of one encoded commit that a reader accepts."""
RETRACTS_MAX = 4096
EVIDENCE_BYTES_MAX = 1 << 31
"""Bytes of all evidence of a commit, unpacked: 179 M voxels. A sweep of 64 beams to 80 m at 4 cm has 29 M to 58 M."""
BRICKS_MAX = 1 << 22
"""Bricks of 8^3 voxels that a commit touches; the same sweep touches 1.0 M to 1.8 M."""
EVIDENCE_ALLOWANCE_BYTES = 1 << 29
EVIDENCE_PER_BYTE = 1 << 12
BRICKS_ALLOWANCE = 1 << 17
BRICKS_PER_BYTE = 1
"""Content that a commit of any size may stand for, and what each of its bytes adds. Merging takes microseconds at each
brick, though 679 bytes can name 2^17. Sweeps and images of open air have 2.7 to 25 bytes for each brick, and one byte
for 2 kB of evidence at most (decision 019)."""

SMALLER = "commit after fewer scans, with a smaller max_range_m, or on a map with larger voxels"
"""Next step after `too_large`."""

Finite = Annotated[float, Field(allow_inf_nan=False)]


class ScanPose(BaseModel):
    """Pose of the rig at one scan: translation (m), unit quaternion x y z w, and one sigma for each (m, rad)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    time_s: Finite
    t_map_rig: tuple[Finite, Finite, Finite]
    q_map_rig: tuple[Finite, Finite, Finite, Finite]
    sigma_m: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    sigma_rad: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0


class CommitMeta(BaseModel):
    """Facts of a commit besides its evidence."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    id: Annotated[str, Field(max_length=96)]
    geometry: Hex32 | None = None
    """Digest of the map's geometry; what is for another grid is refused. None in version 2, which has `layers`."""
    layers: Annotated[tuple[LayerIdentity, ...], Field(max_length=16), FailFast()] = ()
    """Layers of which it has cells; only in version 2."""
    epoch: Annotated[int, Field(ge=-EPOCH_MAX, le=EPOCH_MAX)] | None = None
    """Epoch of the evidence, from the time of the last scan; None: it has no time."""
    parent: Hex32 | None = None
    """SHA-256 of the author's previous commit."""
    seen: Annotated[str, Field(max_length=128)] | None = None
    """Cursor of the server's state that the author had when it made the commit."""
    captured_s: tuple[Finite, Finite] | None = None
    """Times of the first and the last scan, UTC seconds since 1970."""
    scans: Annotated[tuple[ScanPose, ...], Field(max_length=4096), FailFast()] = ()
    sensors: Annotated[tuple[Annotated[str, Field(max_length=64)], ...], Field(max_length=64), FailFast()] = ()
    rig: Hex32 | None = None
    integrator: Annotated[str, Field(max_length=256)] = ""
    """Name, version and parameters of the program that turned images into evidence."""
    retracts: Annotated[
        tuple[Annotated[str, Field(max_length=96)], ...], Field(max_length=RETRACTS_MAX), FailFast()
    ] = ()
    note: Annotated[str, Field(max_length=1024)] = ""
    marks: Annotated[tuple[Mark, ...], Field(max_length=MARKS_MAX), FailFast()] = ()
    """Its marks, by number; only in version 3, of a commit without cells."""
    layer: LayerDefinition | None = None
    """Layer of the map that begins with it; only in version 4, of a commit without cells."""
    kind: Literal["commit"] = "commit"

    @model_validator(mode="after")
    def _ids_are_ids(self) -> Self:
        try:
            own = commit_id_from_text(self.id)
            named = [commit_id_from_text(text) for text in self.retracts]
        except BadInputError as exc:
            raise ValueError(exc.message) from exc
        if own in named or len(set(named)) != len(named):
            raise ValueError("a commit names others to retract, each once")
        return self

    @model_validator(mode="after")
    def _one_version(self) -> Self:
        if (self.geometry is None) != bool(self.layers) or (self.epoch is not None and not self.layers):
            raise ValueError("a commit names either its geometry, or its layers and epoch")
        if len(self.layers) > LAYERS_MAX:
            raise ValueError(f"this reader knows commits of {LAYERS_MAX} layer, got {len(self.layers)}")
        if self.marks and (self.layers or len(self.retracts) > AMENDED_MAX):
            raise ValueError(f"a commit with marks names its geometry, and at most {AMENDED_MAX} commits to retract")
        # Each mark is listed with the commits that its commit takes out.
        if len(self.marks) * len(self.retracts) > MARKS_MAX:
            raise ValueError(
                f"{len(self.marks)} marks take the place of at most {MARKS_MAX // len(self.marks)} commits, "
                f"got {len(self.retracts)}"
            )
        if self.layer is not None and (self.layers or self.marks or self.retracts):
            raise ValueError("a commit that defines a layer names its map's geometry, and holds nothing else")
        return self

    @property
    def version(self) -> int:
        """Version of the commit's bytes."""
        if self.layer is not None:
            return LAYER_VERSION
        if self.marks:
            return MARK_VERSION
        return EPOCH_VERSION if self.layers else SUM_VERSION

    @property
    def grid(self) -> str:
        """Digest of the geometry of its cells, in hex."""
        return self.layers[0].geometry if self.layers else self.geometry or ""

    @property
    def row(self) -> Epoch:
        """Row of the cells' histories to which the evidence is added."""
        return BASE if self.epoch is None else Epoch(self.epoch)

    @property
    def may_have_cells(self) -> bool:
        """True if its version has cells."""
        return self.version in (SUM_VERSION, EPOCH_VERSION)

    @property
    def commit_id(self) -> CommitId:
        """The id, parsed."""
        return commit_id_from_text(self.id)

    @property
    def retracted_ids(self) -> tuple[CommitId, ...]:
        """The ids that this commit takes out, parsed."""
        return tuple(commit_id_from_text(text) for text in self.retracts)


@dataclass(frozen=True, slots=True, repr=False)
class Commit:
    """A whole commit: its meta, its cells' bytes, its SHA-256 (32 bytes), and all its bytes."""

    meta: CommitMeta
    cells: Mapping[CellKey, bytes]
    sha: bytes
    data: bytes

    def __repr__(self) -> str:
        return f"Commit({self.id}, {len(self.cells)} cells, {len(self.data)} bytes)"

    def __str__(self) -> str:
        return f"commit {self.id}: {len(self.cells)} cells, {len(self.data)} bytes"

    @property
    def id(self) -> CommitId:
        """The commit's id."""
        return self.meta.commit_id

    @property
    def text(self) -> bytes:
        """Bytes of the meta, over which the SHA-256 is taken."""
        return self.data[HEAD.size : HEAD.size + int(HEAD.unpack_from(self.data)[2])]


def make_commit(
    meta: CommitMeta, diff: Mapping[CellKey, Evidence], grid: Geometry | MapLayer, *, profile: Profile = Profile.FAST
) -> Commit:
    """Commit of a measurement's evidence; cells without evidence are left out. Its SHA is the same in every profile.

    Args:
        meta: facts of the commit, whose digests are those of the grid.
        diff: evidence by cell.
        grid: the map's geometry; of a map with epochs, its layer.
        profile: coding of the cells.

    Raises:
        BadInputError: negative evidence, sums without weight, too many cells, or larger than a reader would accept.
    """
    layer = grid if isinstance(grid, MapLayer) else MapLayer(geometry=grid)
    geometry = layer.geometry
    if meta.grid != geometry.digest().hex() or meta.layers != (layer.identities if meta.may_have_cells else ()):
        raise BadInputError("other_geometry", "the commit's meta names another geometry than its evidence has")
    # Only evidence that adds, and that has weights.
    held = {key: evidence for key, evidence in diff.items() if len(evidence)}
    if held and not meta.may_have_cells:
        raise BadInputError("bad_commit", "a commit has either evidence, or marks, or defines a layer; make two of it")
    for evidence in held.values():
        if evidence.is_signed:
            raise negative_evidence()
        check_samples(evidence.samples, geometry)
    # The bytes, and the identity over meta and digests.
    encoded = encode_cells(held, geometry, profile=profile)
    cells = {key: cell.data for key, cell in encoded.items()}
    digests = [cell.digest for cell in encoded.values()]
    text = meta.model_dump_json(exclude_defaults=True).encode()
    data = commit_bytes(text, cells, version=meta.version)
    # All limits of a reader, so that no server refuses the commit later.
    _check_size(len(data), len(cells), len(text))
    check_evidence_size(sum(evidence.size_bytes for evidence in diff.values()), evidence_limit_bytes(len(data)))
    check_bricks(sum(evidence.brick_count for evidence in diff.values()), size_bytes=len(data))
    return Commit(meta, cells, commit_sha(text, digests, version=meta.version), data)


def sha_without_evidence(data: bytes) -> bytes | None:
    """SHA-256 of a commit's bytes if it holds no evidence; None if it holds some.

    Raises:
        DamagedDataError: cut off or contradictory.
        BadInputError: an unknown version, or larger than allowed.
    """
    meta, text, bodies = split_bytes(data)
    return None if bodies else commit_sha(text, [], version=meta.version)


def renamed_commit(
    data: bytes, *, commit: CommitId, parent: str | None, retracts: tuple[str, ...] | None = None
) -> Commit:
    """The evidence of a commit that was validated when it was kept, under another id, or naming other targets."""
    meta, cells = split_commit(data)
    targets = meta.retracts if retracts is None else retracts
    meta = meta.model_copy(update={"id": str(commit), "parent": parent, "retracts": targets})
    text = meta.model_dump_json(exclude_defaults=True).encode()
    digests = [decode_cell(body).digest for body in cells.values()]
    version = meta.version
    sha, whole = commit_sha(text, digests, version=version), commit_bytes(text, cells, version=version)
    return Commit(meta, cells, sha, whole)


def split_commit(data: bytes) -> tuple[CommitMeta, dict[CellKey, bytes]]:
    """Meta and cells' bytes of a commit that was validated when it was kept; no evidence is decoded.

    Raises:
        DamagedDataError: cut off or contradictory.
        BadInputError: an unknown version, or larger than allowed.
    """
    meta, _, bodies = split_bytes(data)
    return meta, {decode_head(body)[0].key: body for body in bodies}


def negative_evidence() -> BadInputError:
    """The error of a commit with negative evidence."""
    return BadInputError("negative_evidence", "a commit only adds evidence; to undo, name a commit in a retract")


def check_samples(samples: npt.NDArray[np.int64], geometry: Geometry) -> None:
    """Refuse sums without weight.

    Raises:
        BadInputError: kind `bad_evidence`.
    """
    if not every_sum_has_weight(samples, geometry):
        raise BadInputError("bad_evidence", "a channel has sums without weight, or more votes than its weight")


def evidence_limit_bytes(size_bytes: int) -> int:
    """Most evidence of a commit of so many bytes, in bytes unpacked."""
    return min(EVIDENCE_BYTES_MAX, EVIDENCE_ALLOWANCE_BYTES + EVIDENCE_PER_BYTE * size_bytes)


def check_evidence_size(evidence_bytes: int, limit_bytes: int) -> None:
    """Refuse more evidence than a reader takes of a commit.

    Raises:
        BadInputError: kind `too_large`.
    """
    if evidence_bytes > limit_bytes:
        raise BadInputError(
            "too_large",
            f"a commit of this size has at most {limit_bytes} bytes of evidence, got {evidence_bytes}; {SMALLER}",
        )


def commit_bytes(text: bytes, cells: Mapping[CellKey, bytes], *, version: int = SUM_VERSION) -> bytes:
    """Bytes of a commit, from the bytes of its meta and of its cells, rising in number."""
    parts = [HEAD.pack(MAGIC, version, len(text)), text, struct.pack("<I", len(cells))]
    layer = (0,) if version == EPOCH_VERSION else ()
    for data in cells.values():
        parts += [CELL_PREFIX[version].pack(*layer, len(data)), data]
    return b"".join(parts)


def check_bricks(bricks: int, *, size_bytes: int) -> None:
    """Refuse a commit that touches more bricks than its bytes may stand for.

    Raises:
        BadInputError: kind `too_large`.
    """
    bricks_max = min(BRICKS_MAX, BRICKS_ALLOWANCE + BRICKS_PER_BYTE * size_bytes)
    if bricks > bricks_max:
        raise BadInputError(
            "too_large", f"a commit of {size_bytes} bytes touches at most {bricks_max} bricks, got {bricks}; {SMALLER}"
        )


def split_bytes(data: bytes) -> tuple[CommitMeta, bytes, list[bytes]]:
    """Meta of a commit, the bytes of the meta, and the bytes of its cells.

    Raises:
        DamagedDataError: cut off or contradictory.
        BadInputError: an unknown version, or larger than allowed.
    """
    # Head: sizes are checked before anything is read by them.
    if len(data) < HEAD.size or data[:4] != MAGIC:
        raise DamagedDataError("bad_commit", "not a cairn commit: it must begin with CRCM and a whole head")
    _, version, meta_bytes = HEAD.unpack_from(data)
    prefix = CELL_PREFIX.get(version)
    if prefix is None:
        raise BadInputError("unknown_version", f"this reader knows commits of version 1 to 4, got {version}")
    _check_size(len(data), 0, meta_bytes)
    # Meta.
    text = data[HEAD.size : HEAD.size + meta_bytes]
    at = HEAD.size + meta_bytes + 4
    if at > len(data):
        raise DamagedDataError("bad_commit", "the commit is cut off in its meta")
    try:
        meta = CommitMeta.model_validate_json(text, strict=True)
        # Readers differ in which of two equal keys they take, and the SHA-256 is the same for all of them.
        _UNIQUE.decode(text.decode())
    except ValidationError as exc:
        errors = exc.errors(include_url=False, include_input=False)
        if any(set(error["loc"]) & EVICTION_FIELDS for error in errors):
            raise BadInputError("unknown_version", "this reader knows no layers that let old rows go") from None
        if any(error["loc"][:1] == ("layer",) and error["type"] in NEWER for error in errors):
            raise BadInputError("unknown_version", "this reader knows no layers of this kind") from None
        if any(error["loc"] == ("marks",) and error["type"] == "too_long" for error in errors):
            raise BadInputError(
                "too_many_marks", f"a commit has at most {MARKS_MAX} marks; make several of it"
            ) from None
        raise DamagedDataError("bad_commit", f"commit meta: {first_error(exc)}") from None
    if meta.version != version:
        raise DamagedDataError("bad_commit", f"a commit of version {version} has the meta of version {meta.version}")
    # Cells: a length that is cut off counts as too large, so that `at` passes the end.
    (count,) = struct.unpack_from("<I", data, at - 4)
    _check_size(len(data), count, meta_bytes)
    if count and not meta.may_have_cells:
        raise DamagedDataError("bad_commit", "a commit with marks, or one that defines a layer, has no cells")
    bodies: list[bytes] = []
    for _ in range(count):
        # Layer 0 is the only one, so a prefix of version 2 is one zero and the length.
        is_whole = at + prefix.size <= len(data)
        *layer, size = prefix.unpack_from(data, at) if is_whole else (len(data),)
        if any(layer):
            raise DamagedDataError("bad_commit", "a cell is of a layer that the commit does not name")
        bodies.append(data[at + prefix.size : at + prefix.size + size])
        at += prefix.size + size
    if at != len(data):
        raise DamagedDataError("bad_commit", "the commit is cut off, or bytes are left over")
    return meta, text, bodies


def _object(pairs: list[tuple[str, object]]) -> None:
    if len({key for key, _ in pairs}) != len(pairs):
        raise DamagedDataError("bad_commit", "commit meta: a key is there twice")


_UNIQUE = json.JSONDecoder(object_pairs_hook=_object, parse_int=float)
"""Decoder that refuses duplicate keys; made once, because `json.loads` would make one at each call."""


def _check_size(size_bytes: int, cells: int, meta_bytes: int) -> None:
    if size_bytes > COMMIT_BYTES_MAX or cells > CELLS_MAX or meta_bytes > META_BYTES_MAX:
        raise BadInputError(
            "too_large",
            f"a commit has at most {COMMIT_BYTES_MAX} bytes, {CELLS_MAX} cells and {META_BYTES_MAX} bytes of meta; "
            f"got {size_bytes}, {cells} and {meta_bytes}",
        )


def commit_sha(text: bytes, digests: list[bytes], *, version: int = SUM_VERSION) -> bytes:
    """Identity of a commit: SHA-256 over the bytes of its meta and its cells' digests."""
    sha = hashlib.sha256(b"cairn-commit-%d" % version + struct.pack("<II", len(text), len(digests)) + text)
    for digest in digests:
        sha.update(digest)
    return sha.digest()


def version_of_meta(text: bytes) -> int:
    """Version of a validated commit, by the bytes of its meta: 4 defines a layer, 3 has marks, 2 names its layers."""
    if b"layer" not in text and b"marks" not in text and b"\\" not in text:  # nor is a name written in escapes
        return SUM_VERSION
    fields = json.loads(text)
    if fields.get("layer"):
        return LAYER_VERSION
    if fields.get("marks"):
        return MARK_VERSION
    return EPOCH_VERSION if fields.get("layers") else SUM_VERSION


def living_marks(commits: Iterable[CommitMeta]) -> Mapping[MarkKey, Mark]:
    """Marks of a set of commits less those that any of them takes out, by key; in any order the same."""
    found: dict[MarkKey, Mark] = {}
    out: set[CommitId] = set()
    for meta in commits:
        out.update(meta.retracted_ids)
        commit = meta.commit_id if meta.marks else None
        if commit is not None:
            found |= {MarkKey(commit, number): mark for number, mark in enumerate(meta.marks)}
    return dict(sorted((key, mark) for key, mark in found.items() if key.commit not in out))
