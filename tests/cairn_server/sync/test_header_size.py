"""A reply's header at the limits of PROTOCOL.md section 6: read by every client, and small, whoever filled the map."""

from collections.abc import Iterator

import pytest
from tests.fixtures.server.crowded_map import add_cells, add_commits, long_author
from tests.fixtures.server.fetching import ask_missing
from tests.fixtures.server.live import Live

from cairn_map.commits.ids import NUMBER_LIMIT, OPERATOR, Author, CommitId, Incarnation
from cairn_map.evidence.grid import CELL_LIMIT, Cell, cell_key
from cairn_map.wire.frames import encode_frame, frames_of
from cairn_map.wire.messages import DAMAGED_MAX, WANTED_MAX, CellIndex, MissingRequest, ReplyHeader, message_from_json
from cairn_server.store import shares

HEADER_BYTES_MAX = 1_000_000
RETRACTS = 62_500
LAST = NUMBER_LIMIT - 1
AUTHORS = [long_author(n // shares.INCARNATIONS_MAX, n) for n in range(shares.AUTHORS_MAX - 2)]
SPLIT = shares.INTERVALS_MAX - shares.AUTHORS_MAX
"""Authors whose numbers have a gap."""
ASKER = AUTHORS[0]
DESK = Author(OPERATOR, Incarnation("f" * 16))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server whose first map is as full as a map may be; it takes long to fill, and tests only read it."""
    with Live(tmp_path_factory.mktemp("crowded")) as own, pytest.MonkeyPatch.context() as patch:
        patch.setattr(own.service._fold_thread, "_fold_group", lambda *arguments: 0)
        store, row = own.service.store, own.new_map()
        folded = [CommitId(author, LAST) for author in AUTHORS]
        gaps = [CommitId(author, LAST - 2) for author in AUTHORS[:SPLIT]]
        retracts = [CommitId(DESK, n) for n in range(RETRACTS // 2)]
        retracts += [CommitId(ASKER._replace(incarnation=Incarnation("e" * 16)), n) for n in range(RETRACTS // 2)]
        add_commits(store, row, [*folded, *gaps], age_s=1e7)
        add_commits(store, row, retracts, retracts="r" * 50)
        add_commits(store, row, [CommitId(author, LAST - 1) for author in AUTHORS[SPLIT:]], age_s=None)
        damaged = [cell_key((-CELL_LIMIT + n, -CELL_LIMIT, -CELL_LIMIT)) for n in range(DAMAGED_MAX + 1)]
        add_cells(store, row, damaged)
        own.service.cells._damaged.note(row.name, damaged)
        own.service.sync.retracts._wanted.note(
            row.name, [CommitId(author, LAST) for author in AUTHORS[: WANTED_MAX + 1]], asker=OPERATOR
        )
        yield own


def header_for(live: Live, author: Author | None) -> ReplyHeader:
    """Header of a whole reply about a part of the map without cells."""
    row = live.service.store.map("map0")
    nowhere = (Cell(0, 0, 0), Cell(0, 0, 0))
    answer = ask_missing(live, row, MissingRequest(author=str(author) if author else None, box=nowhere))
    assert answer.status_code == 200, answer.text
    header = frames_of(answer.content)[0]
    assert isinstance(header, ReplyHeader)
    return header


def test_the_header_of_a_map_as_full_as_may_be_is_read_and_is_below_a_megabyte(crowded: Live) -> None:
    for author in (ASKER, None):
        header = header_for(crowded, author)
        assert len(encode_frame(header)) <= HEADER_BYTES_MAX
        assert len(header.coverage.intervals) == shares.AUTHORS_MAX
        assert sum(map(len, header.coverage.intervals.values())) == shares.INTERVALS_MAX
        assert (len(header.damaged), len(header.wanted)) == (DAMAGED_MAX, WANTED_MAX)
    path = "/maps/map0/main/cells?limit=1"
    index = message_from_json(CellIndex, crowded.http.get(path).raise_for_status().content)
    assert len(index.header.model_dump_json()) <= HEADER_BYTES_MAX
    assert index.header.pending


def test_a_header_tells_what_is_stable_and_pending_of_those_whose_commits_the_asker_may_hold(crowded: Live) -> None:
    asker = AUTHORS[-1]
    header = header_for(crowded, asker)
    assert {author.robot for author in header.stable_vector.intervals} == {asker.robot}
    assert header.stable_vector.intervals[asker] == ((LAST, LAST),)
    assert {author.robot for author in header.pending_vector.intervals} == {asker.robot}
    assert header.pending_vector.intervals[asker] == ((LAST - 1, LAST - 1),)


def test_all_of_the_operator_s_retracts_follow_from_the_vectors_and_the_newest_are_listed(crowded: Live) -> None:
    header = header_for(crowded, ASKER)
    unstable = header.coverage.minus(header.stable_vector).of_robots((OPERATOR,))
    assert unstable.intervals == {DESK: ((0, RETRACTS // 2 - 1),)}
    assert header.retracts == [f"{DESK}.{RETRACTS // 2 - 1 - n}" for n in range(1024)]
