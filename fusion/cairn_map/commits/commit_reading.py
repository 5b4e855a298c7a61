"""Reading of a commit's bytes in two steps: first the claims of its meta and its cells' heads, then all of it.

Between the two steps a server decides whether it accepts the commit, and in which process it is decoded.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from cairn_map.codec.cell_code import CanonicalCell, read_canonical_cell
from cairn_map.codec.cell_reading import VOXEL_BYTES, CellReader, cell_reader
from cairn_map.commits.commit import (
    EVIDENCE_BYTES_MAX,
    Commit,
    CommitMeta,
    check_bricks,
    check_evidence_size,
    check_samples,
    commit_sha,
    evidence_limit_bytes,
    negative_evidence,
    split_bytes,
)
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import CellKey


@dataclass(frozen=True, slots=True, eq=False)
class CommitReader:
    """A commit of which only the meta and the heads are decoded; not thread-safe."""

    data: bytes
    meta: CommitMeta
    text: bytes
    bodies: list[bytes]
    readers: list[CellReader]
    """One reader for each of the bodies."""

    @property
    def cells(self) -> dict[CellKey, bytes]:
        """Bytes of the cells, not validated yet."""
        return {reader.head.key: body for reader, body in zip(self.readers, self.bodies, strict=True)}

    def read(self, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> tuple[Commit, Mapping[CellKey, CanonicalCell]]:
        """The commit and its cells, validated completely: canonical, rising, of one geometry.

        This needs up to about twice `evidence_bytes_max` of memory, whatever the bytes say.

        Raises:
            DamagedDataError, BadInputError: as `canonical_cells`.
        """
        cells = {cell.key: cell for cell in self.canonical_cells(evidence_bytes_max=evidence_bytes_max)}
        return self.commit([cell.digest for cell in cells.values()]), cells

    def commit(self, digests: list[bytes]) -> Commit:
        """The commit, of whose cells all were validated and have these digests."""
        return Commit(self.meta, self.cells, commit_sha(self.text, digests, version=self.meta.version), self.data)

    def canonical_cells(self, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> Iterator[CanonicalCell]:
        """The cells, one after the other, each validated completely; the commit is sound once all of them came.

        A caller that keeps none needs the memory of the largest one.

        Raises:
            DamagedDataError: contradictory, not canonical.
            BadInputError: too large, negative evidence, or sums without weight.
        """
        left, bricks = min(evidence_bytes_max, evidence_limit_bytes(len(self.data))), 0
        self._check_heads(left)
        # Each with the evidence that those before it left.
        for reader in self.readers:
            reader.limit_evidence(left)
            cell = read_canonical_cell(reader)
            check_samples(cell.content.samples, cell.geometry)
            left -= cell.content.evidence_bytes
            bricks += cell.content.octree.brick_count
            check_bricks(bricks, size_bytes=len(self.data))
            reader.forget()
            yield cell

    def _check_heads(self, evidence_bytes_max: int) -> None:
        """Refuse a commit by its cells' heads alone, before anything is decoded."""
        last, geometry = -1, None
        for reader in self.readers:
            head = reader.head
            if head.key <= last or not head.voxels:
                raise DamagedDataError("bad_commit", "cells must have evidence and rise in number")
            if head.signed:
                raise negative_evidence()
            if head.geometry is not geometry and head.geometry.digest().hex() != self.meta.grid:
                raise BadInputError("other_geometry", "a cell of the commit has another geometry than its meta names")
            last, geometry = head.key, head.geometry
        check_evidence_size(VOXEL_BYTES * sum(reader.head.voxels for reader in self.readers), evidence_bytes_max)


def commit_reader(data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX) -> CommitReader:
    """Reader of a commit's bytes; the heads and all sizes are checked.

    Raises:
        DamagedDataError: cut off or contradictory.
        BadInputError: an unknown version, or too large.
    """
    meta, text, bodies = split_bytes(data)
    readers = [cell_reader(body, evidence_bytes_max=evidence_bytes_max) for body in bodies]
    return CommitReader(data, meta, text, bodies, readers)


def open_commit(
    data: bytes, *, evidence_bytes_max: int = EVIDENCE_BYTES_MAX
) -> tuple[Commit, Mapping[CellKey, CanonicalCell]]:
    """Commit of bytes and all its evidence, validated completely.

    Raises:
        DamagedDataError, BadInputError: as `commit_reader` and `CommitReader.read`.
    """
    return commit_reader(data, evidence_bytes_max=evidence_bytes_max).read(evidence_bytes_max=evidence_bytes_max)


def validated_commit(data: bytes) -> Commit:
    """Commit of bytes, validated completely in the memory that its largest cell takes.

    Raises:
        DamagedDataError, BadInputError: as `commit_reader` and `CommitReader.canonical_cells`.
    """
    reader = commit_reader(data)
    return reader.commit([cell.digest for cell in reader.canonical_cells()])
