"""Marks: what a map of ten thousand of them answers, and when a listener hears of one, over HTTP.

    $ python -m tests.bench marks

A real server on loopback, and one client in this process. Marks lie at random in a hall of 100 x 100 x 10 m; the box
has about a hundred of them. A listener's time is from before its push until the event is there.
"""

import queue
import random
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator

from tests.bench.timing import wall_s
from tests.fixtures.commands import served, wait_for_fold

from cairn_client.http.api import MapApi
from cairn_client.http.live_listener import listen
from cairn_client.http.mark_pages import mark_pages
from cairn_map.commits.commit import Commit, CommitMeta, make_commit
from cairn_map.commits.mark import Mark, make_mark
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.live_events import Hello, MarksEvent
from cairn_map.wire.messages import CreateMap

Row = tuple[str, str, str]
MAP = "lab"
GEOMETRY = Geometry()
EACH = 100
BOX_M = (20.0, 20.0, 0.0, 30.0, 30.0, 10.0)


def mark_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    count, repeats = (500, 3) if smoke else (10_000, 40)
    with tempfile.TemporaryDirectory() as folder, served("--data", folder) as url, MapApi(url) as api:
        api.create_map(MAP, CreateMap(geometry=GEOMETRY))
        for n in range(count // EACH):
            api.push(MAP, _commit(n, [_mark(n * EACH + k) for k in range(EACH)]))
        wait_for_fold(f"{url}/maps/{MAP}")
        before = [*mark_pages(api, MAP)][-1].cursor
        api.push(MAP, _commit(count, [_mark(0)]))
        wait_for_fold(f"{url}/maps/{MAP}")
        news_s = wall_s(lambda: [*mark_pages(api, MAP, after=before)], repeats)
        yield f"{count} marks: fetch what is new (1)", f"{1e3 * news_s:.1f}", "ms (20 wanted)"
        found = len(next(mark_pages(api, MAP, box_m=BOX_M)).marks)
        box_s = wall_s(lambda: [*mark_pages(api, MAP, box_m=BOX_M)], repeats)
        yield f"{count} marks: list a box of {found}", f"{1e3 * box_s:.1f}", "ms (20 wanted)"
        all_s = wall_s(lambda: [*mark_pages(api, MAP)], max(3, repeats // 10))
        yield f"{count} marks: list all, by pages", f"{1e3 * all_s:.0f}", "ms"
        lags_s = _lags_s(url, api, count, repeats)
        yield "mark pushed -> event at a listener, p50", f"{1e3 * statistics.median(lags_s):.0f}", "ms (300 wanted)"
        yield "  the slowest of them", f"{1e3 * max(lags_s):.0f}", "ms"


def _lags_s(url: str, api: MapApi, first: int, repeats: int) -> list[float]:
    """Time from before each push of a mark until a listener has its event."""
    heard: queue.Queue[float] = queue.Queue()
    is_joined, enough = threading.Event(), repeats

    def hear() -> None:
        left = enough
        with MapApi(url) as listening:
            for event in listen(listening, MAP):
                if isinstance(event, Hello):
                    is_joined.set()
                if isinstance(event, MarksEvent):
                    heard.put(time.perf_counter())
                    left -= 1
                    if not left:
                        return

    listener = threading.Thread(target=hear)
    listener.start()
    is_joined.wait()
    lags_s = []
    for n in range(1, repeats + 1):
        start_s = time.perf_counter()
        api.push(MAP, _commit(first + n, [_mark(n)]))
        lags_s.append(heard.get() - start_s)
    listener.join()
    return lags_s


def _mark(seed: int) -> Mark:
    chance = random.Random(seed)
    place_m = (chance.uniform(0, 100), chance.uniform(0, 100), chance.uniform(0, 10))
    return make_mark(kind="hot_spot", name=f"spot {seed}", at_m=place_m, time_s=1.8e9, note="seen from the stairs")


def _commit(n: int, marks: list[Mark]) -> Commit:
    meta = CommitMeta(id=f"mole.0123456789abcdef.{n}", geometry=GEOMETRY.digest().hex(), marks=tuple(marks))
    return make_commit(meta, {}, GEOMETRY)
