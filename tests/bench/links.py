"""What robots pay for their map on the wire, counted by a proxy: bodies and heads of HTTP, both ways.

One robot maps the building at 4 cm; the others fetch after each of its measurements, join late, join late over a link
that is cut at random, or find nothing new.
"""

import statistics
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from random import Random

from tests.bench.git_peer import GitPeer, missing, plain_file
from tests.bench.pushing import Server, facts_of, served
from tests.crowd.building import SCANS, Survey, survey
from tests.fixtures.server.live import until
from tests.links.proxy import Cut, Fault, FaultProxy

from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import UnreachableError
from cairn_map.evidence.grid import cell_of_key

Row = tuple[str, str, str]
FRAMES_BETWEEN_CUTS = 20
CUTS: tuple[Cut, ...] = ("close", "half", "reset")


def link_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    seen = survey(robot="orpheus", voxel_m=0.08 if smoke else 0.04, stops=4 if smoke else None)
    with ExitStack() as stack:
        server = stack.enter_context(served(seen.geometry))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        api = stack.enter_context(MapApi(f"http://127.0.0.1:{server.port}"))
        git = None if missing() else GitPeer(folder)
        if git is not None:
            stack.callback(git.close)
        link = stack.enter_context(FaultProxy(server.port))
        ant, bee = (stack.enter_context(_robot(name, link, folder, seen)) for name in ("ant", "bee"))
        yield from _measurement_rows(seen, server, ant, bee, link, git)
        yield from _still_rows(bee, link)
        info = api.map_info("bench")
        whole_bytes, frames = _late_bytes("late", link, folder, seen)
        name = f"bytes of a robot that joins late, {info.cells} cells"
        yield name, f"{whole_bytes}", f"B = {whole_bytes / info.size_bytes:.3f} x the map at rest (at most 1.05)"
        yield from _waste_rows(seen, server, folder, whole_bytes, frames, robots=2 if smoke else 10)


def _robot(name: str, link: FaultProxy, folder: Path, seen: Survey) -> Robot:
    url = f"http://127.0.0.1:{link.port}/maps/bench"
    return Robot(None, url, directory=folder / f"robot-{name}", name=name, geometry=seen.geometry)


def _measurement_rows(
    seen: Survey, server: Server, ant: Robot, bee: Robot, link: FaultProxy, git: GitPeer | None
) -> Iterator[Row]:
    """What one more robot pays for each measurement, and what git does for the same cells."""
    ours, theirs = [], []
    for robot in (ant, bee):
        robot.sync()
    for n, diff in enumerate(seen.stops):
        ant.replica.commit(diff, facts_of(0, SCANS[0] * SCANS[1]))
        ant.sync()
        until(lambda n=n: server.folded() > n, "it is folded")  # type: ignore[misc]
        before = link.size_bytes
        bee.sync()
        ours.append(link.size_bytes - before)
        if git is not None:
            packed = ant.map.packed()
            cells = {key: encode_cell(key, packed[key], seen.geometry).data for key in diff}
            git.push({f"{cell_of_key(key)}.cell": plain_file(data) for key, data in cells.items()})
            theirs.append(git.fetched_bytes())
    name = f"bytes on the wire per measurement and other robot, {100 * seen.geometry.voxel_edge_m:g} cm"
    yield name, f"{statistics.mean(ours):.0f}", f"B, heads included; {len(ours)} measurements"
    if not theirs:
        yield "  git, the same cells uncompressed", "skipped", missing()
        return
    yield (
        "  git, the same cells uncompressed, repacked",
        f"{statistics.mean(theirs):.0f}",
        f"B: ours are {sum(ours) / sum(theirs):.2f} of it (at most 0.7)",
    )


def _still_rows(robot: Robot, link: FaultProxy) -> Iterator[Row]:
    robot.sync()
    before, requests = link.size_bytes, len(link.requests)
    robot.sync()
    count = len(link.requests) - requests
    yield "sync when nothing changed", f"{link.size_bytes - before}", f"B, heads included (below 600), {count} request"


def _late_bytes(name: str, link: FaultProxy, folder: Path, seen: Survey) -> tuple[int, int]:
    """Bytes and frames until a new robot has the whole map, however often it must ask."""
    before = link.size_bytes
    frames = 0
    with _robot(name, link, folder, seen) as robot:
        while True:
            try:
                frames = robot.sync().frames
                break
            except UnreachableError:
                continue
        return link.size_bytes - before, frames


def _waste_rows(
    seen: Survey, server: Server, folder: Path, whole_bytes: int, frames: int, *, robots: int
) -> Iterator[Row]:
    random = Random(6)
    mean_bytes = FRAMES_BETWEEN_CUTS * whole_bytes / frames

    def fault() -> Fault:
        return Fault(down_bytes=random.expovariate(1 / mean_bytes), cut=random.choice(CUTS))

    with FaultProxy(server.port, fault=fault) as link:
        paid_bytes = sum(_late_bytes(f"cut{n}", link, folder, seen)[0] for n in range(robots))
        waste = paid_bytes / (robots * whole_bytes) - 1
        name = f"waste with cuts at random, mean {FRAMES_BETWEEN_CUTS} frames apart"
        yield name, f"{100 * waste:.1f}", f"% (at most 5), {link.cuts} cuts in {robots} joins"
