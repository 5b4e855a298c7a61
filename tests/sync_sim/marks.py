"""Marks in a simulation: those of robots and operators, who follows them, and what they must be."""

from random import Random

from tests.sync_sim.robot import MemoryDisk
from tests.sync_sim.server import SimServer

from cairn_client.replica.mark_copy import MarkCopy
from cairn_map.commits.mark import Mark, MarkKey, make_mark
from cairn_map.errors import ConflictError, NotFoundError
from cairn_map.wire.mark_messages import MarkPage, MarkRequest, MarkText
from cairn_server.access.auth import Caller, Role

BY = Caller(Role.ADMIN, name="ada")
Marks = dict[MarkKey, Mark]


def has_marks(seed: int) -> bool:
    """True for every third seed: its robots and operators mark, with epochs and without."""
    return seed % 3 == 0


def any_marks(random: Random) -> tuple[Mark, ...]:
    """Marks of a robot's commit; mostly none, for then it has evidence."""
    count = random.choice((0, 0, 1, 3))
    return tuple(
        make_mark(kind="spot", name=f"n{random.randrange(9)}", at_m=(random.randrange(9), 0, 0), time_s=1.7e9)
        for _ in range(count)
    )


def mark_as_operator(server: SimServer, random: Random) -> None:
    """An operator adds a mark, or changes or removes anybody's."""
    known = sorted(map(str, marks_of(server)))
    of = random.choice(known) if known and random.random() < 0.7 else None
    text = (
        None
        if of and random.random() < 0.4
        else MarkText(kind="spot", name=f"o{random.randrange(99)}", place_m=(0, 0, 0))
    )
    try:
        server.service.sync.marking.put(server.row, MarkRequest(of=of, mark=text), by=BY)
    except NotFoundError as exc:
        assert exc.kind == "no_mark"
    except ConflictError as exc:
        assert exc.kind == "evidence_gone"


def marks_of(server: SimServer) -> Marks:
    """Marks that a server lists."""
    return MarkFollower().followed(server)


def marks_by_definition(server: SimServer) -> Marks:
    """Marks of all commits that are in the map, less those of commits that any of these takes out."""
    with server._store._maps.reading(server.row) as state:
        folded = [kept.new for kept in state.commits.values() if kept.folded_seq is not None]
    out = {target for new in folded for target in new.retracts}
    return {
        MarkKey(new.id, number): mark for new in folded if new.id not in out for number, mark in enumerate(new.marks)
    }


class MarkFollower:
    """Client that has the marks of a server, and asks for what is new; it may be sent to another server."""

    def __init__(self) -> None:
        self._copy = MarkCopy(MemoryDisk())

    def follow(self, server: SimServer, random: Random) -> None:
        """Ask for one page of a few marks."""
        self._take(server, limit=random.randint(1, 3))

    def followed(self, server: SimServer) -> Marks:
        """All marks, once all pages came."""
        while self._take(server, limit=7).more:
            pass
        return dict(sorted((entry.mark_key, entry.mark) for entry in self._copy.entries()))

    def _take(self, server: SimServer, *, limit: int) -> MarkPage:
        page = server.service.sync.marking.page(server.row, after=self._copy.cursor, limit=limit, box=None)
        self._copy.take(page)
        return page
