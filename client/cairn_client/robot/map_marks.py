"""Marks as one robot sees them: those of the server's map, and its own that are not in it yet."""

import logging
from collections.abc import Sequence
from itertools import islice

from cairn_client.http.api import MapApi
from cairn_client.http.mark_pages import mark_pages
from cairn_client.replica.mark_copy import MarkCopy
from cairn_client.replica.replica import Replica
from cairn_map.commits.commit import living_marks
from cairn_map.commits.ids import map_of_layer
from cairn_map.commits.mark import Mark
from cairn_map.errors import BadInputError, CairnError, UnreachableError
from cairn_map.wire.mark_messages import MarkEntry

log = logging.getLogger(__name__)

PAGES_MAX = 200
"""Most pages that are taken at a time: a server that never comes to an end must not hold up a round for ever."""


def check_has_marks(map_name: str) -> None:
    """Refuse what concerns marks to a robot of a layer.

    Raises:
        BadInputError: kind `layer_of_map`.
    """
    whole = map_of_layer(map_name)
    if whole is not None:
        raise BadInputError(
            "layer_of_map",
            f"{map_name} is a layer of map {whole}, and marks are the map's: mark by a robot of {whole}, or as an "
            "operator (cairn map mark)",
        )


def follow_marks(api: MapApi, copy: MarkCopy, map_name: str) -> None:
    """Bring the copy of a map's marks to the map's present state.

    Raises:
        BadInputError: kind `layer_of_map`: it is a layer.
        CairnError: the server refuses, or there is no link; what came before stays.
    """
    check_has_marks(map_name)
    for page in islice(mark_pages(api, map_name, after=copy.cursor), PAGES_MAX):
        copy.take(page)


def keep_following(api: MapApi, replica: Replica, map_name: str) -> None:
    """Bring the copy on, if there is one and the map moved since; a server that has no marks costs the round nothing.

    Raises:
        UnreachableError: the link broke, or the disk is full.
    """
    header = replica.header
    if replica.marks.cursor is None or header is None or replica.marks.cursor == header.to:
        return
    try:
        follow_marks(api, replica.marks, map_name)
    except UnreachableError:
        raise
    except CairnError as exc:
        log.warning("the marks of map %s cannot be followed: %s: %s", map_name, exc.kind, exc.message)


def seen_marks(replica: Replica, box_m: Sequence[float] | None = None) -> list[MarkEntry]:
    """Marks of the copy, all or those in a box, without those that own commits that wait take out; then own ones.

    Args:
        replica: the robot's state.
        box_m: x0, y0, z0, x1, y1, z1, metres.

    Raises:
        BadInputError: kind `bad_box`.
    """
    if box_m is not None and (len(box_m) != 6 or not all(map(float.__le__, map(float, box_m[:3]), box_m[3:]))):
        raise BadInputError(
            "bad_box", f"a box is x0, y0, z0, x1, y1, z1 in metres, the lower corner first, got {box_m}"
        )
    waiting = {meta.commit_id: meta for meta in replica.waiting_metas()}
    out = {commit for meta in waiting.values() for commit in meta.retracted_ids}
    entries = {entry.mark_key: entry for entry in replica.marks.entries() if entry.mark_key.commit not in out}
    own = {
        key: MarkEntry(key=str(key), mark=mark, amends=waiting[key.commit].retracts)
        for key, mark in living_marks(waiting.values()).items()
    }
    return [entry for entry in (own | entries).values() if box_m is None or _is_in(entry.mark, box_m)]


def _is_in(mark: Mark, box_m: Sequence[float]) -> bool:
    corners = zip(mark.low_mm, mark.high_mm, box_m[:3], box_m[3:], strict=True)
    return all(low <= 1000 * end and 1000 * begin <= high for low, high, begin, end in corners)
