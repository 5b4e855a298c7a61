"""Pages of a map's marks, one after the other: all of them, or what came and went since a state."""

from collections.abc import Iterator, Sequence

from cairn_client.http.api import MapApi
from cairn_map.wire.mark_messages import MarkPage


def mark_pages(
    api: MapApi, map_name: str, *, box_m: Sequence[float] | None = None, after: str | None = None
) -> Iterator[MarkPage]:
    """Pages from a state (None: the start) to the map's present one; at least one.

    Args:
        api: the server.
        map_name: the map.
        box_m: x0, y0, z0, x1, y1, z1: only marks in this box, metres; None: everywhere.
        after: cursor of an earlier page.

    Raises:
        CairnError: the server refuses, or there is no link.
    """
    while True:
        page = api.marks(map_name, box_m=box_m, after=after)
        yield page
        if not page.more:
            return
        after = page.cursor
