"""Order of the frames of a reply, and frames that may be left out."""

import numpy as np
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.fetching import ask_missing, fetch
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import MOLE, SCANS, WREN, pushed
from tests.naive.asker import NaiveAsker

from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import cell_key, cell_of_key
from cairn_map.wire.frames import CellFrame, frames_of
from cairn_map.wire.messages import MissingRequest
from cairn_map.wire.resumed_replies import reply_digest
from cairn_server.store.store_rows import MapRow

PLACES = [(0, 0, 0), (3, 0, 0), (-1, 1, 0), (2, 2, 2), (-4, 0, 1), (1, 0, 0)]


def seen(live: Live) -> MapRow:
    """A map of several cells, one commit each, in this order."""
    row = live.new_map()
    for n, place in enumerate(PLACES):
        evidence = random_evidence(n, SMALL, voxels=6, air=1)
        assert live.push(row, pushed(n, 0, WREN, cells={cell_key(place): evidence}, scans=SCANS)).status_code == 201
        live.folded(row)
    return row


def order(live: Live, row: MapRow, request: MissingRequest) -> list[tuple[int, int, int]]:
    frames = frames_of(ask_missing(live, row, request).content)
    return [tuple(cell_of_key(frame.cell)) for frame in frames if isinstance(frame, CellFrame)]  # type: ignore[misc]


def test_the_newest_cells_come_first(live: Live) -> None:
    assert order(live, seen(live), MissingRequest()) == PLACES[::-1]


def test_the_cells_next_to_the_asker_come_first_and_of_equally_far_ones_the_newest(live: Live) -> None:
    row = seen(live)
    for near in ((0, 0, 0), (3, 1, 1), (-9, 0, 0)):
        found = order(live, row, MissingRequest(near=near))
        rings = [int(np.abs(np.subtract(place, near)).max()) for place in found]
        assert rings == sorted(rings)
        newest = [PLACES.index(place) for place in found]
        assert all(a > b for a, b, p, q in zip(newest, newest[1:], rings, rings[1:], strict=False) if p == q)


def test_a_hot_cell_comes_before_cold_ones_that_are_as_far_or_a_little_nearer(live: Live) -> None:
    row = live.new_map()
    for n, (i, kelvin) in enumerate([(0, 293), (1, 295), (40, 650), (4, 299), (5, 288), (9, 290), (8, 650)]):
        samples = np.zeros((1, SMALL.plane_count), np.int64)
        samples[:, SMALL.planes_of("temperature")] = 20 * kelvin, (20 * kelvin) ** 2, 1
        evidence = packed_evidence(np.zeros(1, np.uint32), np.ones((1, 2), np.int32), samples, SMALL)
        live.push(row, pushed(n, 0, WREN, cells={cell_key((i, 0, 0)): evidence}, scans=SCANS))
        live.folded(row)
    whole = [i for i, _, _ in order(live, row, MissingRequest(near=(0, 0, 0)))]
    assert whole == [0, 1, 8, 4, 5, 9, 40]
    cut = [i for i, _, _ in order(live, row, MissingRequest(near=(0, 0, 0), size_bytes_max=1000))]
    assert cut == whole[: len(cut)] and 8 in cut and 40 not in cut


def test_a_small_reply_has_the_nearest_cell(live: Live) -> None:
    row = seen(live)
    for place in PLACES:
        assert order(live, row, MissingRequest(near=place, size_bytes_max=1))[0] == place


def test_a_place_outside_the_grid_is_refused(live: Live) -> None:
    row = live.new_map()
    for near in ((1 << 70, 0, 0), (0, 0, -(1 << 21))):
        assert kind_of(ask_missing(live, row, MissingRequest(near=near))) == "cell_range"


def test_a_reply_that_is_known_is_not_sent_again(live: Live) -> None:
    row = seen(live)
    asker = NaiveAsker(MOLE)
    fetch(live, row, asker)
    first = ask_missing(live, row, asker.request())
    again = asker.request().model_copy(update={"known": reply_digest(first.content)})
    answer = ask_missing(live, row, again)
    assert (answer.status_code, answer.content) == (204, b"")
    live.push(row, pushed(9, 3, WREN))
    live.folded(row)
    assert ask_missing(live, row, again).status_code == 200
