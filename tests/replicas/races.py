"""Two servers that do at once what may happen in one order only, thousands of times."""

import random
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from tests.crash.verdict import cells_of, sum_of
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.commit_contract import new_map
from tests.fixtures.server.crowd_contract import all_at_once
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.shares_contract import author_of, refusal
from tests.fixtures.server.store_contract import new_of
from tests.replicas.fault_run import postgres_in

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import OPERATOR
from cairn_server.folding.cell_cache import CellCache
from cairn_server.folding.folding import fold_pending
from cairn_server.store.postgres.store import PgStore

BODIES = 15
"""Commits of as many kinds, so that their evidence is made once."""
APART_S = 0.004
"""Longest time by which one of the two begins later."""


@dataclass(slots=True)
class Races:
    """What came of a run."""

    ends: Counter[str] = field(default_factory=Counter)
    """Count of each way in which a race ended."""
    wrong: list[str] = field(default_factory=list)

    @property
    def is_sound(self) -> bool:
        """True if each race ended in one order or the other."""
        return not self.wrong

    def rows(self) -> Iterator[tuple[str, str]]:
        """Lines for people."""
        for end, count in sorted(self.ends.items()):
            yield end, f"{count}"
        yield "wrong", f"{len(self.wrong)} {self.wrong[:5]}"


def races_run(programs: Path, *, turns: int, seed: int = 0) -> Races:
    """Both kinds of races, so many turns each, on a database of two stores."""
    found, chance = Races(), random.Random(seed)
    with postgres_in(programs) as postgres:
        postgres.execute("CREATE DATABASE cairn")
        url = postgres.url("cairn")
        with closing(PgStore(url)) as store, closing(PgStore(url)) as other:
            retract_against_forget(store, other, found, chance, turns=turns)
            push_against_push(store, other, found, chance, turns=turns)
    return found


def retract_against_forget(store: PgStore, other: PgStore, found: Races, chance: random.Random, *, turns: int) -> None:
    """A retract is taken, or the evidence that it needs is forgotten: never both, and never neither."""
    row, cache, kept = new_map(store), CellCache(SMALL), list[Commit]()
    for turn in range(turns):
        target = pushed(turn, turn % BODIES)
        store.append(row, new_of(target))
        fold_pending(store, row, cache, limit=9)
        retract = pushed(turn, 0, author_of(OPERATOR), cells={}, retracts=[target])
        refused: list[str | None] = []

        def take_out(retract: Commit = retract, refused: list[str | None] = refused) -> None:
            refused.append(refusal(store, row, new_of(retract)))

        _race(chance, take_out, lambda: other.forget_evidence(row, before_s=1e12, limit=99))
        stored = store.commit(row, target.id)
        is_gone = stored is None or stored.gone
        if (refused, is_gone) not in (([None], False), (["evidence_gone"], True)):
            found.wrong.append(f"turn {turn}: the retract {refused}, evidence gone: {is_gone}")
        found.ends["retract taken" if refused == [None] else "evidence forgotten"] += 1
        kept += [target] if refused != [None] else []
        fold_pending(store, row, cache, limit=9)
    if cells_of(store, row) != sum_of(kept):
        found.wrong.append("the cells are not the sum of the commits that were not taken out")


def push_against_push(store: PgStore, other: PgStore, found: Races, chance: random.Random, *, turns: int) -> None:
    """Of two commits of one id one is kept, and its server alone says that it is."""
    row = new_map(store)
    for turn in range(turns):
        offered = [pushed(turn, (turn + k) % BODIES) for k in range(2)]
        refused: list[str | None] = [None, None]

        def push(k: int, offered: list[Commit] = offered, refused: list[str | None] = refused) -> None:
            refused[k] = refusal((store, other)[k], row, new_of(offered[k]))

        _race(chance, lambda push=push: push(0), lambda push=push: push(1))
        stored = store.commit(row, offered[0].id)
        if sorted(map(str, refused)) != ["None", "id_taken"] or stored is None:
            found.wrong.append(f"turn {turn}: {refused}")
        elif stored.sha != offered[refused.index(None)].sha:
            found.wrong.append(f"turn {turn}: the commit that was refused is kept")
        found.ends[f"server {refused.index(None)} is first" if None in refused else "no server is first"] += 1


def _race(chance: random.Random, one: Callable[[], object], other: Callable[[], object]) -> None:
    """Do both at once, or one a moment later than the other."""
    waits = [chance.uniform(0.0, APART_S) * chance.getrandbits(1) for _ in range(2)]

    def run(job: Callable[[], object], wait_s: float) -> None:
        threading.Event().wait(wait_s)
        job()

    all_at_once([lambda: run(one, waits[0]), lambda: run(other, waits[1])])
