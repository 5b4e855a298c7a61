"""Policy of pushes beyond well-formedness: whose a commit may be, and how much evidence its scans can have given.

Evidence is refused before it can spoil a map: counts that no scan could give would outvote every honest robot,
and use up the range of the sums for everybody; ids full of gaps would grow every version vector without bound.
"""

import math
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from cairn_map.codec.cell_code import CanonicalCell
from cairn_map.codec.octree.cell_content import CellContent
from cairn_map.commits.commit import META_BYTES_MAX, CommitMeta
from cairn_map.commits.ids import INITIAL, OPERATOR
from cairn_map.commits.mark import check_place
from cairn_map.epochs.epoch import Epoch, begin_s, epoch_of
from cairn_map.errors import BadInputError, DamagedDataError, DeniedError, UnreachableError
from cairn_map.evidence.channels import SAMPLE_MAX, VOTE_MAX, planes_and_squares
from cairn_map.evidence.evidence_kernels import bounds_of_counts, channel_above
from cairn_map.evidence.grid import Geometry, cell_of_key
from cairn_server.access.auth import Caller
from cairn_server.map_refusals import layer_of_map
from cairn_server.store.store_rows import MapRow

MAIN = "main"
TIME_MAX_S = 1e11
"""As of a status. Ages are shown from the newest time: one that is infinite would make all others so."""
AGAIN_MAX_S = 3600.0
"""Longest time after which a commit from the future is tried again: the clock that is wrong may be this one."""

EDIT_BYTES = 1 << 13
"""Room in a meta for what an operator's edit says of one mark, at most 6 kB with the longest texts."""


def check_claims(row: MapRow, caller: Caller, id_text: str, meta: CommitMeta, *, cells: int) -> None:
    """Refuse a commit by its meta alone, before its evidence is decoded.

    Raises:
        BadInputError: kind `other_id`, `other_geometry`, `other_layer`, `reserved_name`, `bad_commit`, `bad_mark`,
            `bad_place`, `layer_of_map` or `too_large`.
        DeniedError: kind `not_allowed`: made by, or retracting from, a robot that the caller is not; or a robot defines
            a layer.
        DamagedDataError: kind `empty_commit`.
    """
    if meta.id != id_text:
        raise BadInputError("other_id", f"the path names {id_text[:96]}, the commit calls itself {meta.id}")
    _check_layer(row, meta)
    authors = {meta.commit_id.author.robot, *(target.author.robot for target in meta.retracted_ids)}
    foreign = sorted(author for author in authors if not caller.may_author(author))
    if foreign:
        raise DeniedError("not_allowed", f"this token stands for {caller.robot or caller.role}, not for {foreign[0]}")
    if meta.commit_id.author.robot == MAIN:
        raise BadInputError("reserved_name", f"{MAIN} is not a robot's name")
    times = [*(meta.captured_s or ()), *(scan.time_s for scan in meta.scans)]
    if any(abs(time_s) > TIME_MAX_S for time_s in times):
        raise BadInputError("bad_commit", f"a time of the commit is beyond {TIME_MAX_S:g} s since 1970")
    if not cells and not meta.retracts and not meta.marks and meta.layer is None:
        raise DamagedDataError("empty_commit", "a commit must hold evidence or marks, or name commits to retract")
    _check_part_of_map(row, meta)
    for mark in meta.marks:
        check_place(mark, row.geometry)
        # Who reads `by` trusts the server that wrote it: a robot has no other name than its own.
        if mark.by and meta.commit_id.author.robot != OPERATOR:
            said = f"the mark {mark.name!r} speaks for {mark.by!r}; a robot marks in its own name, without `by`"
            raise BadInputError("bad_mark", said)
    _check_room(meta)


def _check_part_of_map(row: MapRow, meta: CommitMeta) -> None:
    """Refuse what only a map as a whole has, its marks and layers, in a layer; and layers by any author but operators.

    Raises:
        BadInputError: kind `layer_of_map`.
        DeniedError: kind `not_allowed`.
    """
    if row.of_map is not None and meta.marks:
        raise layer_of_map(row.name, "marks are the map's; push them there")
    if meta.layer is None:
        return
    if row.of_map is not None:
        raise layer_of_map(row.name, "a layer has no layers; push its definition to the map")
    if meta.commit_id.author.robot != OPERATOR:
        raise DeniedError("not_allowed", "an operator defines layers (cairn map layer add); a robot maps into them")


def _check_room(meta: CommitMeta) -> None:
    """Refuse a robot's marks that no operator could edit: his commit repeats them all, with the robot's name.

    Raises:
        BadInputError: kind `too_large`.
    """
    robot = meta.commit_id.author.robot
    if not meta.marks or robot == OPERATOR:
        return
    names_bytes = len(meta.marks) * len(f',"by":"{robot}"')
    size_bytes = len(meta.model_dump_json(exclude_defaults=True).encode()) + names_bytes
    if size_bytes > META_BYTES_MAX - EDIT_BYTES:
        raise BadInputError(
            "too_large",
            f"with its robot's name at each mark this commit's meta has {size_bytes} bytes, at most "
            f"{META_BYTES_MAX - EDIT_BYTES}, so that an operator can change one of them; make several commits of it",
        )


def check_epoch(epoch: Epoch, epoch_s: int, *, now_s: float) -> None:
    """Refuse a commit from the future, by any caller: it would outrank all others until its time has come.

    The epoch after the present one is taken: clocks differ, and that costs no more than a delay.

    Args:
        epoch: of the commit.
        epoch_s: length of the map's epochs, seconds.
        now_s: time of day, UTC seconds since 1970.

    Raises:
        UnreachableError: kind `bad_clock`: to be tried again when its time has come.
    """
    if epoch <= epoch_of(now_s, epoch_s) + 1:
        return
    wait_s = begin_s(Epoch(epoch - 1), epoch_s) - now_s
    now = datetime.fromtimestamp(now_s, UTC).isoformat(timespec="seconds")
    raise UnreachableError(
        "bad_clock",
        f"the commit's measurement is {wait_s + epoch_s:.0f} s in the future: the server's time is {now_s:.3f} ({now})",
        retry_after_s=math.ceil(min(wait_s, AGAIN_MAX_S)),
    )


def _check_layer(row: MapRow, meta: CommitMeta) -> None:
    """Refuse evidence of another grid, or by other epochs. Without epochs it is any map's of the grid: the base."""
    if meta.grid != row.geometry.digest().hex():
        raise BadInputError(
            "other_geometry", f"the commit was made for another grid than map {row.name} has ({row.geometry})"
        )
    if meta.layers and meta.layers != row.layer.identities:
        has = f"epochs of {row.epoch_s} s" if row.layer.has_epochs else "no epochs"
        raise BadInputError(
            "other_layer",
            f"the commit was made for a map with epochs of {meta.layers[0].epoch_s} s in layer {meta.layers[0].name}, "
            f"map {row.name} has {has} in layer {row.layer.name}",
        )


def check_evidence(meta: CommitMeta, cell: CanonicalCell, tops: npt.NDArray[np.int64]) -> None:
    """Refuse more evidence in a cell than the scans can have given; prior data (author `initial`) had other scans.

    The largest number of each plane is known.

    Raises:
        BadInputError: kind `too_much_evidence`.
    """
    if meta.commit_id.author.robot == INITIAL:
        return
    scans = max(1, len(meta.scans))
    complaint = _excess(cell.content, cell.geometry, tops, scans, cameras=max(1, len(set(meta.sensors))))
    if complaint:
        raise BadInputError("too_much_evidence", f"cell {cell_of_key(cell.key)}: {complaint} from {scans} scans")


def _excess(
    content: CellContent, geometry: Geometry, tops: npt.NDArray[np.int64], scans: int, *, cameras: int
) -> str | None:
    """Description of the first excess in a cell; None: there is none."""
    counts = bounds_of_counts(content.counts)[3]
    if counts > scans:
        return f"{counts} counts in one voxel"
    for channel in geometry.channels:
        weight = int(tops[1 + geometry.planes_of(channel.name).stop])
        # One sample of weight 1 a scan, as there is one count (decision 002); of classes one vote a camera (042).
        if weight > (VOTE_MAX * cameras if channel.classes else scans):
            return f"weight {weight} of {channel.name} in one voxel"
    # Weights are at most 2^12 here and a square below 2^40, so that the products fit.
    above = channel_above(content.samples, planes_and_squares(geometry.channels), SAMPLE_MAX)
    return None if above < 0 else f"samples of {geometry.channels[above].name} above {SAMPLE_MAX} steps"
