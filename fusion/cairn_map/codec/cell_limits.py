"""What a reader of a cell refuses by its head and the sizes of its streams alone."""

from cairn_map.codec.entropy.modelled_stream import check_effort
from cairn_map.codec.octree.cell_content import CHILD_MASKS, HITS, LEAF_MASKS
from cairn_map.codec.octree.cell_head import CellHead
from cairn_map.codec.octree.channel_streams import stream_of_channel
from cairn_map.codec.octree.streams import MODELLED, StoredStream
from cairn_map.errors import BadInputError

VOXEL_BYTES = 12
"""Of packed evidence: a voxel's number and two counts."""


def sampled_max_of(head: CellHead, evidence_bytes_max: int) -> int:
    """How many leaves of a cell may have samples, so that its evidence stays within a bound.

    Raises:
        BadInputError: kind `too_large`: its voxels alone are too many.
    """
    sampled_max = (evidence_bytes_max - VOXEL_BYTES * head.voxels) // (4 + 8 * head.geometry.plane_count)
    if sampled_max < 0:
        raise BadInputError("too_large", f"{head.voxels} voxels are more than {evidence_bytes_max} bytes of evidence")
    return sampled_max


def check_efforts(head: CellHead, stored: dict[int, StoredStream]) -> None:
    """Refuse modelled groups of too few bytes on the head's word, before a leaf is looked for.

    Raises:
        BadInputError: kind `too_large`.
    """
    if all(stream.coding != MODELLED for stream in stored.values()):
        return
    masks = sum(stored[number].raw_bytes for number in (CHILD_MASKS, LEAF_MASKS) if number in stored)
    firsts = [HITS, *(stream_of_channel(c) for c in range(len(head.geometry.channels)))]
    for first, numbers in {CHILD_MASKS: masks, **dict.fromkeys(firsts, head.leaves)}.items():
        if first in stored and stored[first].coding == MODELLED:
            check_effort(numbers, stored[first].body)
