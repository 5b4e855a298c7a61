"""One soak: servers of its own, a map of the building, the crowd on it, and what came of it."""

import asyncio
import multiprocessing
import secrets
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from urllib.parse import urlsplit

from tests.crowd.building import Survey
from tests.crowd.crowd import Crowd, CrowdRobot, fetch_all, listen, live_together
from tests.crowd.figures import Seen
from tests.crowd.watch import Sample, Watch
from tests.crowd.whole_robots import WholeReport, live_whole
from tests.fixtures.server.live import Process
from tests.fixtures.server.postgres import programs_of
from tests.replicas.fault_run import postgres_in

from cairn_client.http.api import MapApi
from cairn_map.wire.messages import CreateMap, MapInfo

MAP = "building"
FOLDED_S = 120.0
"""So long after the last push everything must be in the map."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """All that was measured."""

    crowd: Crowd
    seen: Seen
    samples: list[Sample]
    start_s: float
    """When the first robot came, on the samples' clock."""
    whole: WholeReport
    info: MapInfo
    """Of the map in the end."""
    at_head: int
    """Robots that stood at the head in the end."""
    exit_code: int
    complaints: str
    """Text that the servers wrote to standard error."""


Progress = Callable[[float, Seen, list[Sample]], None]


def soak(
    crowd: Crowd,
    seen_by: Survey,
    folder: Path,
    *,
    whole_robots: int,
    every_s: float,
    progress: Progress,
    servers: int = 1,
) -> Outcome:
    """Let a crowd live on a server, or on several.

    Args:
        crowd: how many robots, for how long.
        seen_by: what they push.
        folder: of the server's store; it exists.
        whole_robots: how many more there are that keep the map.
        every_s: between two calls of `progress`.
        progress: told the seconds so far, and what was seen.
        servers: one has its store in the folder; several share a PostgreSQL, and one more process folds.
    """
    token = secrets.token_urlsafe(32)
    secret = folder / "admin"
    secret.write_text(token)
    secret.chmod(0o600)
    options = "--admin-token-file", str(secret)
    with _serving(folder, servers, *options) as site, MapApi(site.urls[0], token=token) as api:
        api.create_map(MAP, CreateMap(geometry=seen_by.geometry))
        asyncio.run(_lay_out(site.urls[0], token, seen_by))
        seen, watch = Seen(folded_before=len(seen_by.stops)), Watch(site.pids, every_s=min(5.0, crowd.seconds / 20))
        with watch, _whole_robots(site.urls[-1], token, whole_robots, seen_by, crowd) as pipe:
            start_s = time.perf_counter()
            tell = (lambda: progress(time.perf_counter() - start_s, seen, watch.samples), every_s)
            at_head = asyncio.run(_live(crowd, seen_by, seen, api, [_port(url) for url in site.urls], pipe, tell))
            whole: WholeReport = pipe.recv()
        info = api.map_info(MAP)
    return Outcome(crowd, seen, watch.samples, start_s, whole, info, at_head, site.exit_code, site.complaints)


@dataclass(slots=True)
class _Site:
    """Servers of one store."""

    urls: list[str]
    pids: list[int]
    """With those of what is behind them."""
    exit_code: int = 0
    """The worst, once they ended."""
    complaints: str = ""


@contextmanager
def _serving(folder: Path, servers: int, *options: str) -> Iterator[_Site]:
    with ExitStack() as stack:
        members: list[Process] = []
        pids: list[int] = []
        if servers == 1:
            members.append(Process(folder / "store", *options))
        else:
            postgres = stack.enter_context(postgres_in(programs_of("wheel")))
            postgres.execute("CREATE DATABASE cairn")
            pids.append(postgres.pid)
            for n, role in enumerate(["--no-fold"] * servers + ["--fold-only"]):
                members.append(Process(folder / f"store{n}", "--store", postgres.url("cairn"), role, *options))
        assert all(member.url for member in members), "a server did not start"
        site = _Site([str(member.url) for member in members[:servers]], pids + [member.pid for member in members])
        try:
            yield site
        finally:
            for member in members:
                member.send(signal.SIGTERM)
            ends = [member.end() for member in members]
            site.exit_code = max(code for code, _ in ends)
            site.complaints = "".join(said for _, said in ends)


async def _lay_out(url: str, token: str, seen_by: Survey) -> None:
    """The map as it is when the crowd comes: one commit of each stop."""
    bodies, seen = seen_by.stop_bodies(), Seen()
    surveyor = CrowdRobot(_port(url), token, MAP, 0, bodies, seen)
    surveyor.name = "surveyor"
    await surveyor.join()
    for _ in seen_by.stops:
        await surveyor.push()
    surveyor.link.close()


async def _live(
    crowd: Crowd,
    seen_by: Survey,
    seen: Seen,
    api: MapApi,
    ports: Sequence[int],
    pipe: Connection,
    tell: tuple[Callable[[], None], float],
) -> int:
    """The crowd's life, and its last fetch; how many robots stand at the head then."""
    token = str(api.token)
    bodies = seen_by.scan_bodies()
    robots = [CrowdRobot(ports[n % len(ports)], token, MAP, n, bodies, seen) for n in range(crowd.robots)]
    around = [asyncio.create_task(listen(ports[n % len(ports)], MAP, token, seen)) for n in range(crowd.listeners)]
    around.append(asyncio.create_task(_every(*tell)))
    await live_together(crowd, robots, seen, start_s=time.perf_counter())
    with ThreadPoolExecutor(1) as aside:
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(aside, _quiet, pipe, api)
        head = api.map_info(MAP).cursor
        at_head = await fetch_all(robots, seen, head)
        await asyncio.sleep(0.5)
    for task in around:
        task.cancel()
    await asyncio.gather(*around, return_exceptions=True)
    for robot in robots:
        seen.sent_bytes += robot.link.sent_bytes
        seen.received_bytes += robot.link.received_bytes
        robot.link.close()
    pipe.send("compare")
    return at_head


def _quiet(pipe: Connection, api: MapApi) -> None:
    """Return when nobody pushes any more, and everything is folded."""
    pipe.send("stop")
    pipe.recv()
    end_s = time.perf_counter() + FOLDED_S
    while api.cell_index(MAP).header.pending:
        assert time.perf_counter() < end_s, f"not folded {FOLDED_S:g} s after the last push"
        time.sleep(0.1)


async def _every(work: Callable[[], None], seconds: float) -> None:
    while True:
        await asyncio.sleep(seconds)
        work()


@contextmanager
def _whole_robots(url: str, token: str, count: int, seen_by: Survey, crowd: Crowd) -> Iterator[Connection]:
    """Some robots in a process of their own; the pipe to it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    names = [f"whole{n}" for n in range(count)]
    told = (f"{url}/maps/{MAP}", token, names, seen_by.scans[:: max(1, len(seen_by.scans) // 32)], seen_by.geometry)
    process = context.Process(target=live_whole, args=(theirs, *told, [crowd.sync_s, crowd.push_s]))
    process.start()
    theirs.close()
    try:
        yield ours
    finally:
        ours.close()
        with suppress(OSError):
            process.join(60.0)
            process.kill()


def _port(url: str) -> int:
    return int(urlsplit(url).port or 0)
