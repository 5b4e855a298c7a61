"""Many maps: eight folded by two processes next to one by one, and a thousand in use beside ten thousand idle ones.

Commits lie in the store before anybody folds, so that folding alone is measured, from a tenth of them on: the first
ones load kernels. Robots of the thousand maps have pushed before they are measured: the first push of each writes more
rows, and a team pushes for hours. Of these maps each commit's lag is the time from its receipt, by the database's
clock, until it does not wait any more, seen every tenth of a second.
"""

import http.client
import itertools
import json
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import psycopg
from tests.bench.pushing import Bodies, Diff, Server, cpu_s_of, with_children
from tests.bench.server import scan_diffs
from tests.fixtures.server.postgres import PostgresServer, programs_of
from tests.replicas.fault_run import postgres_in

from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_server.store.postgres.schema import IS_WAITING
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store import Store

Row = tuple[str, str, str]
MAPS = 8
ROBOTS_EACH = 5
PUSHERS = 8
LOOK_S = 0.1
WARM_S = 6.0
IDLE = """
WITH made AS (
    INSERT INTO map (name, geometry, sensor_model, seal_key)
    SELECT 'idle' || n, geometry, sensor_model, seal_key FROM map, generate_series(1, %s) n WHERE name = 'map0'
    RETURNING map
)
INSERT INTO head (map, log_id, seq, chain, fingerprint)
SELECT made.map, log_id, seq, chain, fingerprint FROM made, head
WHERE head.map = (SELECT map FROM map WHERE name = 'map0')
"""


def many_map_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    geometry = geometry_for(voxel_edge_m=0.04)
    diffs = scan_diffs("orpheus", geometry, scale=0.25, scans=2 if smoke else 24)
    count = 40 if smoke else 1600
    yield from _folded_rows(diffs, geometry, count)
    maps, idle, seconds = (60, 20, 2.0) if smoke else (1000, 10_000, 60.0)
    yield from _crowd_rows(diffs, geometry, maps, idle, seconds)


def _folded_rows(diffs: list[Diff], geometry: Geometry, count: int) -> Iterator[Row]:
    alone = _folded_by_sqlite(diffs, geometry, count)
    yield f"{count} commits folded: SQLite, one map", f"{alone:.0f}", "/s"
    one = _folded_by_postgres(diffs, geometry, count, maps=1, folders=1)
    yield "  PostgreSQL, one map, one process folds", f"{one:.0f}", f"/s, {one / alone:.2f} of SQLite's (1 wanted)"
    many = _folded_by_postgres(diffs, geometry, count, maps=MAPS, folders=2)
    yield f"  PostgreSQL, {MAPS} maps, two fold", f"{many:.0f}", f"/s, {many / one:.2f} times one map's (1.6 wanted)"


def _folded_by_sqlite(diffs: list[Diff], geometry: Geometry, count: int) -> float:
    with tempfile.TemporaryDirectory() as name:
        store = SqliteStore(Path(name))
        _fill(store, Bodies(diffs, geometry), ["bench"], count)
        store.close()
        server = Server(Path(name), geometry)
        try:
            return _rate(server.folded, count)
        finally:
            server.close()


def _folded_by_postgres(diffs: list[Diff], geometry: Geometry, count: int, *, maps: int, folders: int) -> float:
    with postgres_in(programs_of("wheel")) as postgres, tempfile.TemporaryDirectory() as name:
        postgres.execute("CREATE DATABASE cairn")
        url = postgres.url("cairn")
        store = PgStore(url)
        _fill(store, Bodies(diffs, geometry), [f"map{n}" for n in range(maps)], count)
        store.close()
        with ExitStack() as stack, ThreadPoolExecutor(folders) as pool:  # they start at once

            def start(n: int) -> Server:
                return Server(Path(name) / str(n), geometry, "--store", url, "--fold-only")

            for server in pool.map(start, range(folders)):
                stack.enter_context(closing(server))
            link = stack.enter_context(psycopg.connect(url, autocommit=True))
            return _rate(lambda: _number(link, "SELECT sum(folded) FROM head"), count)


def _fill(store: Store, bodies: Bodies, maps: Sequence[str], count: int) -> None:
    rows = [store.create_map(name, bodies.geometry, SensorModel())[0] for name in maps]
    for n in range(count):
        store.append(rows[n % len(rows)], bodies.commit("mole", n // len(rows)))


def _rate(folded: Callable[[], int], count: int) -> float:
    """Commits folded a second, from a tenth of them to the last."""
    first_s, first = time.perf_counter(), 0
    while (now := folded()) < count:
        if not first and now >= count / 10:
            first_s, first = time.perf_counter(), now
        time.sleep(0.02)
    return (count - first) / (time.perf_counter() - first_s)


def _number(link: psycopg.Connection, query: str) -> int:
    row = link.execute(query).fetchone()
    return int(row[0]) if row and row[0] is not None else 0


@dataclass(slots=True)
class _Load:
    """Times of the pushes of robots on many maps, and of their folding."""

    pushes_s: list[float] = field(default_factory=list)
    lags_s: list[float] = field(default_factory=list)
    refused: int = 0


def _crowd_rows(diffs: list[Diff], geometry: Geometry, maps: int, idle: int, seconds: float) -> Iterator[Row]:
    load, bodies = _Load(), Bodies(diffs, geometry)
    robots = maps * ROBOTS_EACH
    with postgres_in(programs_of("wheel")) as postgres, tempfile.TemporaryDirectory() as name:
        postgres.execute("CREATE DATABASE cairn")
        url, members = postgres.url("cairn"), []
        store = PgStore(url)
        rows = [store.create_map(f"map{n}", geometry, SensorModel())[0] for n in range(maps)]
        for n in range(robots):
            store.append(rows[n % maps], bodies.commit(f"robot{n // maps}", 0))
        store.close()
        with ExitStack() as stack:
            for n, role in enumerate(("--no-fold", "--no-fold", "--fold-only")):
                server = Server(Path(name) / str(n), geometry, "--store", url, role)
                members.append(stack.enter_context(closing(server)))
            tokens = _registered(members[:2], maps)
            with psycopg.connect(url, autocommit=True) as link:
                link.execute(IDLE, [idle])
                while _number(link, "SELECT sum(folded) FROM head") < robots:
                    time.sleep(LOOK_S)
            commits = ((*tokens[n % robots], 1 + n // robots) for n in itertools.count())
            _push_all(members[:2], bodies, commits, robots, WARM_S, _Load())  # the first ones load kernels
            with psycopg.connect(url, autocommit=True) as link:
                link.execute("ANALYZE")  # as the database does by itself each minute
            before_s = _cpu_s(members, postgres)
            watch = _Watch(url, load)
            watch.start()
            _push_all(members[:2], bodies, commits, robots, seconds, load)
            watch.end()
            after_s = _cpu_s(members, postgres)
    count = len(load.pushes_s)
    title = f"{maps} maps of {ROBOTS_EACH} robots, a push a minute each, {idle} idle maps"
    yield title, f"{count / seconds:.0f}", f"pushes/s for {seconds:g} s, {load.refused} refused"
    yield "  push p50", f"{1e3 * statistics.median(load.pushes_s):.0f}", f"ms, p99 {1e3 * _p99(load.pushes_s):.0f} ms"
    lags = f"s, p99 {_p99(load.lags_s):.2f} s (3 s wanted), longest {max(load.lags_s):.2f} s"
    yield "  fold lag p50", f"{statistics.median(load.lags_s):.2f}", lags
    serving, folding, database = (1e3 * (now - before) / count for now, before in zip(after_s, before_s, strict=True))
    yield (
        "  processor time of serving",
        f"{serving:.2f}",
        f"ms a commit, of folding {folding:.2f}; database {database:.2f}",
    )


def _cpu_s(members: Sequence[Server], postgres: PostgresServer) -> tuple[float, float, float]:
    """Processor time so far, seconds: of the servers, of the last member, which folds, and of the database."""
    *serving, folding = members
    return sum(server.cpu_s() for server in serving), folding.cpu_s(), cpu_s_of(with_children(postgres.pid))


def _p99(times_s: Sequence[float]) -> float:
    return sorted(times_s)[int(0.99 * (len(times_s) - 1))]


def _registered(servers: Sequence[Server], maps: int) -> list[tuple[str, str, str]]:
    """For each robot its map, name and token; the robots of a map are far from each other."""
    links = [http.client.HTTPConnection("127.0.0.1", server.port, timeout=60) for server in servers]
    found = []
    for n, robot in itertools.product(range(ROBOTS_EACH), range(maps)):
        body = json.dumps({"robot": f"robot{n}", "incarnation": "0" * 16}).encode()
        kind = {"Content-Type": "application/json"}
        answer = _asked(links[robot % len(links)], "POST", f"/maps/map{robot}/branches", body, kind)
        found.append((f"map{robot}", f"robot{n}", str(json.loads(answer[1])["token"])))
    for link in links:
        link.close()
    return found


def _asked(
    link: http.client.HTTPConnection, method: str, path: str, body: bytes, headers: dict[str, str]
) -> tuple[int, bytes]:
    link.request(method, path, body, headers)
    answer = link.getresponse()
    return answer.status, answer.read()


def _push_all(
    servers: Sequence[Server],
    bodies: Bodies,
    commits: Iterator[tuple[str, str, str, int]],
    a_minute: int,
    seconds: float,
    load: _Load,
) -> None:
    """Push commits (map, robot, token, number) at an even rate."""
    lock, start_s = threading.Lock(), time.perf_counter()
    due = ((start_s + n * 60.0 / a_minute, *commit) for n, commit in enumerate(commits))
    end_s = start_s + seconds

    def work(port: int) -> None:
        link = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        while True:
            with lock:
                due_s, name, robot, token, n = next(due)
            if due_s >= end_s:
                link.close()
                return
            time.sleep(max(0.0, due_s - time.perf_counter()))
            path = f"/maps/{name}/commits/{robot}.{'0' * 16}.{n}"
            headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/vnd.cairn.commit"}
            data = bodies.body(robot, n)
            start_s = time.perf_counter()
            status, _ = _asked(link, "PUT", path, data, headers)
            if status == 201:
                load.pushes_s.append(time.perf_counter() - start_s)
            else:
                load.refused += 1

    threads = [threading.Thread(target=work, args=[servers[n % len(servers)].port]) for n in range(PUSHERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


class _Watch(threading.Thread):
    """Looks which commits wait, until none does after the end."""

    def __init__(self, url: str, load: _Load) -> None:
        super().__init__(daemon=True)
        self._url = url
        self._load = load
        self._ending = threading.Event()

    def end(self) -> None:
        """Wait until everything is folded."""
        self._ending.set()
        self.join()

    def run(self) -> None:
        """Look every tenth of a second."""
        waiting: dict[tuple[int, int], float] = {}
        seen = 0
        with psycopg.connect(self._url, autocommit=True) as link:
            while not self._ending.is_set() or waiting:
                time.sleep(LOOK_S)
                query = f"SELECT map, number, received_s FROM commits WHERE {IS_WAITING}"
                found = {(row[0], row[1]): row[2] for row in link.execute(query)}
                now_s = time.time()
                gone = waiting.keys() - found.keys()
                self._load.lags_s += [now_s - waiting[commit] for commit in gone]
                seen += len(gone)
                waiting = found
        # Those that never were seen to wait were folded within one look.
        self._load.lags_s += [LOOK_S] * (len(self._load.pushes_s) - seen)
