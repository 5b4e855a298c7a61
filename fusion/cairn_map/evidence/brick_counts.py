"""Hits and misses of one cell: bricks of 8^3 voxels under a dense index.

    brick_of [Morton number of a brick] -> b or -1      pool [b, 512, 2] hits, misses of all its voxels

The pool has 16 bits a count until a sum may need 32. A bound of all magnitudes decides: each diff's counts raise it
while they are added; only when it passes the limit are they subtracted again, and the true sums examined.
"""

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Int32s
from cairn_map.errors import BadInputError
from cairn_map.evidence import brick_kernels as kernels
from cairn_map.evidence.evidence import COUNT_MAX
from cairn_map.evidence.grid import BRICK_DEPTH

Voxels = npt.NDArray[np.uint32]
BrickNumbers = npt.NDArray[np.int16]
Pool = npt.NDArray[np.int16] | npt.NDArray[np.int32]


class BrickCounts:
    """Sums of counts; voxels are given rising and inside the cell."""

    __slots__ = ("_bound", "_brick_of", "_pool")

    def __init__(self, depth: int) -> None:
        self._brick_of: BrickNumbers = np.full(8 ** (depth - BRICK_DEPTH), -1, np.int16)
        self._pool: Pool = np.zeros((0, 512, 2), np.int16)
        self._bound = 0

    def add(self, voxels: Voxels, counts: Int32s, sign: int) -> None:
        """Add sign * counts.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range; nothing was changed.
        """
        new = kernels.count_new_bricks(voxels, self._brick_of)
        if new:
            used = len(self._pool)
            self._pool.resize((used + new, 512, 2), refcheck=False)  # in place if possible; there is no other view
            kernels.number_bricks_into(voxels, self._brick_of, used)
        said = kernels.add_counts_into(voxels, counts, sign, self._brick_of, self._pool)
        if said >= 0 and self._bound + said <= self._limit:
            self._bound += said
            return
        # A sum may have wrapped around. Subtraction restores the sums exactly; then the bound is found first.
        kernels.add_counts_into(voxels, counts, -sign, self._brick_of, self._pool)
        self._bound = self._bound_after(voxels, counts, sign)
        kernels.add_counts_into(voxels, counts, sign, self._brick_of, self._pool)

    def packed(self, sampled: Voxels) -> tuple[Voxels, Int32s, Voxels]:
        """Voxels with a count or listed in `sampled`, rising; their counts; and the rows of the listed ones."""
        V = kernels.count_packed(self._brick_of, self._pool, sampled)
        out = np.empty(V, np.uint32), np.empty((V, 2), np.int32), np.empty(len(sampled), np.uint32)
        kernels.pack_into(self._brick_of, self._pool, sampled, *out)
        return out

    def of_voxels(self, voxels: Voxels) -> Int32s:
        """(V, 2) counts of some voxels."""
        bricks = self._brick_of[voxels >> np.uint32(9)]
        counts = np.zeros((len(voxels), 2), np.int32)
        there = bricks >= 0
        counts[there] = self._pool[bricks[there], voxels[there] & np.uint32(511)]
        return counts

    def copy(self) -> "BrickCounts":
        """The same sums in arrays of its own."""
        copied = BrickCounts.__new__(BrickCounts)
        copied._brick_of, copied._pool, copied._bound = self._brick_of.copy(), self._pool.copy(), self._bound
        return copied

    def zeros(self) -> "BrickCounts":
        """The same bricks without hits and misses, in the memory of one number; to be read only."""
        copied = BrickCounts.__new__(BrickCounts)
        copied._brick_of, copied._bound = self._brick_of, 0
        copied._pool = np.broadcast_to(np.int16(0), self._pool.shape)
        return copied

    @property
    def brick_of(self) -> BrickNumbers:
        """(8^(depth - 3),) row of `pool` by a brick's Morton number, -1 where there is none; to be read only."""
        return self._brick_of

    @property
    def pool(self) -> Pool:
        """(B, 512, 2) hits and misses of each brick's voxels in Morton order; to be read only."""
        return self._pool

    @property
    def size_bytes(self) -> int:
        """Memory held by the arrays."""
        return self._brick_of.nbytes + self._pool.nbytes

    @property
    def _limit(self) -> int:
        return int(np.iinfo(self._pool.dtype).max)

    def _bound_after(self, voxels: Voxels, counts: Int32s, sign: int) -> int:
        """Bound of all magnitudes after adding sign * counts; widens the pool if 16 bits may not be enough.

        Raises:
            BadInputError: kind `evidence_overflow`: a sum would leave its range.
        """
        largest = kernels.largest_count(counts)
        bound = self._bound + largest
        if bound <= self._limit:
            return bound
        bound = kernels.largest_count(self._pool) + largest
        if bound > COUNT_MAX and not kernels.counts_fit(voxels, counts, sign, self._brick_of, self._pool, COUNT_MAX):
            raise BadInputError("evidence_overflow", f"counts are at most {COUNT_MAX}; a sum would be more")
        if bound > self._limit // 2:  # early, else every further diff would examine all sums again
            self._pool = self._pool.astype(np.int32, copy=False)
        return min(bound, COUNT_MAX)
