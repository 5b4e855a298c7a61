"""Servers that share a database next to one server with SQLite, in the same run: pushes, processor time, folding."""

import statistics
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.bench.pushing import Bodies, Diff, Robot, Server, cpu_s_of, with_children
from tests.bench.server import scan_diffs
from tests.fixtures.server.postgres import programs_of
from tests.replicas.fault_run import postgres_in

from cairn_map.evidence.grid import Geometry, geometry_for

Row = tuple[str, str, str]
ROBOTS = 8
FOLDERS = 1
SERVERS = 2


@dataclass(slots=True)
class Load:
    """What robots saw."""

    seconds: list[float] = field(default_factory=list)
    refused: int = 0
    took_s: float = 0.0
    lag_s: float = 0.0
    """From the last push until all was folded."""
    cpu_s: float = 0.0
    """Of the servers and of those that fold."""
    database_s: float = 0.0

    @property
    def per_s(self) -> float:
        """Acknowledged pushes a second."""
        return len(self.seconds) / self.took_s


def scale_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    geometry = geometry_for(voxel_edge_m=0.04)
    diffs = scan_diffs("orpheus", geometry, scale=0.25, scans=2 if smoke else 24)
    seconds = 2.0 if smoke else 15.0
    one = _one_server(diffs, geometry, seconds)
    # One that also folds is enough to see that it runs: each process takes seconds to start.
    roles = {"": 1} if smoke else {"--no-fold": SERVERS, "--fold-only": FOLDERS}
    many = _many_servers(diffs, geometry, seconds, roles)
    size = len(Bodies(diffs, geometry).body("mole", 0))
    shown = ", ".join(f"{count} {role}".rstrip() for role, count in roles.items())
    for name, load in (("SQLite, 1", one), (f"PostgreSQL, {shown}", many)):
        ordered = sorted(load.seconds)
        yield f"{ROBOTS} robots push {size} B for {seconds:g} s: {name}", f"{load.per_s:.0f}", "/s"
        p99 = 1e3 * ordered[int(0.99 * (len(ordered) - 1))]
        yield "  p50", f"{1e3 * statistics.median(ordered):.1f}", f"ms, p99 {p99:.0f} ms, {load.refused} refused"
        count = len(ordered)
        cpu = f"ms a commit, folding included; database {1e3 * load.database_s / count:.2f}"
        yield "  processor time", f"{1e3 * load.cpu_s / count:.2f}", cpu
        yield "  all folded after", f"{load.lag_s:.2f}", "s more"
    yield "pushes of many servers over those of one", f"{many.per_s / one.per_s:.2f}", "(0.8 wanted)"


def _one_server(diffs: list[Diff], geometry: Geometry, seconds: float) -> Load:
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder), geometry)
        try:
            return _pushed(diffs, geometry, [server], [server], [], seconds)
        finally:
            server.close()


def _many_servers(diffs: list[Diff], geometry: Geometry, seconds: float, roles: dict[str, int]) -> Load:
    with postgres_in(programs_of("wheel")) as postgres, tempfile.TemporaryDirectory() as name:
        postgres.execute("CREATE DATABASE cairn")
        store, members = ("--store", postgres.url("cairn")), []
        try:
            for role, count in roles.items():
                options = (*store, role) if role else store
                members += [Server(Path(name) / f"{role}{n}", geometry, *options) for n in range(count)]
            servers = members[: next(iter(roles.values()))]
            return _pushed(diffs, geometry, servers, members, [postgres.pid], seconds)
        finally:
            for member in members:
                member.close()


def _pushed(
    diffs: list[Diff],
    geometry: Geometry,
    servers: Sequence[Server],
    members: Sequence[Server],
    databases: Sequence[int],
    seconds: float,
) -> Load:
    bodies, load = Bodies(diffs, geometry), Load()
    robots = [Robot(servers[n % len(servers)], f"robot{n}") for n in range(ROBOTS)]
    for robot in robots:  # warm
        robot.push(f"{robot.name}.{'0' * 16}.0", bodies.body(robot.name, 0))
    while servers[0].folded() < ROBOTS:
        time.sleep(0.02)

    def cpu_now_s() -> tuple[float, float]:
        return sum(member.cpu_s() for member in members), sum(cpu_s_of(with_children(pid)) for pid in databases)

    cpu_s, database_s = cpu_now_s()
    start_s = time.perf_counter()
    threads = [threading.Thread(target=_push_until, args=(robot, bodies, load, start_s + seconds)) for robot in robots]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    load.took_s = time.perf_counter() - start_s
    while servers[0].folded() < len(load.seconds) + ROBOTS:
        time.sleep(0.02)
    load.lag_s = time.perf_counter() - start_s - load.took_s
    cpu_after_s, database_after_s = cpu_now_s()
    load.cpu_s, load.database_s = cpu_after_s - cpu_s, database_after_s - database_s
    for robot in robots:
        robot.close()
    return load


def _push_until(robot: Robot, bodies: Bodies, load: Load, end_s: float) -> None:
    n = 1
    while time.perf_counter() < end_s:
        data = bodies.body(robot.name, n)
        start_s = time.perf_counter()
        if robot.push(f"{robot.name}.{'0' * 16}.{n}", data) == 201:
            load.seconds.append(time.perf_counter() - start_s)
            n += 1
        else:
            load.refused += 1
