"""What an operator waits for, in Debian's browser without a graphics card, over loopback; and what that costs in bytes.

A picture counts when the graphics card is done with it. The first one is of the whole map, if only coarsely; then as
fine as the page's budget of 150 000 nodes allows. The page is open in the browser before, with an empty map, so that
starting the browser is not counted. With --smoke the map is a few scans of the small room.
"""

import gzip
import signal
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import httpx
from playwright.sync_api import Browser
from tests.bench.building import building_map, wait_until_folded
from tests.bench.pushing import Diff, meta_of
from tests.console.browsing import CHROMIUM, VIEW, Console, browser
from tests.fixtures.server.live import Process

from cairn_client.cli.maps.create import push_prior_data
from cairn_client.http.api import MapApi
from cairn_fusion.mapping.integrate import Integrator, integrate_scans
from cairn_map.codec.view_code import decode_view
from cairn_map.commits.commit import make_commit
from cairn_map.evidence.grid import Geometry, geometry_for
from cairn_map.wire.messages import CreateMap, Register
from cairn_server.http.routes.console import STATIC
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.robots.trajectories import path_names
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
MAP, EMPTY = "lab", "empty"
WATCH = """
performance.setResourceTimingBufferSize(10_000);
window.drawn = async (isThere) => {
  const found = () => window.cairn?.console;
  while (!(found() && isThere(found()))) await new Promise((resolve) => setTimeout(resolve, 4));
  const { cells, stage } = found();
  const { frames } = stage;
  const got = performance.getEntriesByType("resource").filter(({ name }) => name.includes("/maps/"));
  const bytes = got.reduce((sum, { encodedBodySize }) => sum + encodedBodySize, 0);
  while (stage.frames === frames) await new Promise(requestAnimationFrame);
  const gl = stage.renderer.getContext();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits for the graphics card
  return { ms: performance.now(), time_ms: Date.now(), bytes, nodes: cells.drawn, cells: cells.all.size };
};
window.isWhole = ({ cells }) => cells.all.size > 0 && cells.waiting === 0 && !cells.needsPlan;
window.pictures = Promise.all([
  drawn(({ cells }) => cells.firstPictureMs !== null), drawn(isWhole),
]);
"""
"""Of a page: when its first picture and its finest one were drawn, ms since it was asked for, and bytes of both."""
NEXT = """([head]) => {
  window.next = drawn((console) => console.cells.head > head && isWhole(console));
}"""
FRAME = """async () => {
  const { stage } = window.cairn.console;
  const startMs = performance.now();
  const frame = drawn(() => true);
  stage.draw();
  return (await frame).ms - startMs;
}"""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A picture that the graphics card is done with."""

    ms: float
    """Since the page was asked for."""
    time_ms: float
    """Since 1970."""
    bytes: int
    """Of the map, as they came over the wire."""
    nodes: int
    cells: int


def console_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    if CHROMIUM is None or not (STATIC / "index.html").exists():
        yield "the operator's page", "-", "needs chromium (apt-get install chromium) and `make console`"
        return
    files = [path for path in STATIC.rglob("*") if path.suffix in (".html", ".js", ".css", ".svg")]
    size_bytes = sum(len(gzip.compress(path.read_bytes(), 9)) for path in files)
    yield "the operator's page, gzip", f"{size_bytes / 1e3:.0f}", "kB; at most 250 are asked for"
    geometry = geometry_for(voxel_edge_m=0.08 if smoke else 0.04)
    repeats = 1 if smoke else 5
    diffs = _diffs("small-room" if smoke else "building", geometry, scans=4 if smoke else 6)
    with tempfile.TemporaryDirectory() as name, browser() as chromium:
        made = None if smoke else building_map(Path(name), 4, stops=None)
        folder = Path(name) / "server"
        with _served(folder) as url:
            MapApi(url).create_map(EMPTY, CreateMap(geometry=geometry))
            with _page(chromium, url, EMPTY) as console:
                console.until("c", "the page of an empty map")
            _fill(url, geometry, diffs[1:], made)
            yield from _picture_rows("a map that nobody looked at", [_pictures(chromium, url)])
            yield from _picture_rows("a map that was looked at", [_pictures(chromium, url) for _ in range(repeats)])
            yield from _leaf_rows(url, geometry)
        again = []
        for _ in range(repeats):
            with _served(folder) as url:
                again.append(_pictures(chromium, url))
        yield from _picture_rows("a server that was just started", again)
        with _served(folder) as url:
            yield from _push_rows(chromium, url, geometry, diffs[0], 2 if smoke else 8)


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    """A server that asks nobody for a token."""
    server = Process(folder)
    try:
        assert server.url
        yield server.url
    finally:
        server.send(signal.SIGTERM)
        server.end()


def _diffs(scene: str, geometry: Geometry, scans: int) -> list[Diff]:
    """What single scans of a stop say."""
    robot = replace(ROBOTS["orpheus"], scans=(6, 1))
    loaded = load_scene(scene)
    (path, *_) = path_names(scene)
    plan = Plan(scene=loaded, robot=robot, path=path, scale=0.1, truth="none", last_stop=1)
    rig = robot.rig_of(plan.scale)
    found = [scan for _, scan, _ in scans_of(plan, shots_of(plan)[:scans], rig)]
    return [integrate_scans([scan], rig, geometry, integrator=Integrator(), threads=1) for scan in found]


def _fill(url: str, geometry: Geometry, diffs: list[Diff], made: Path | None) -> None:
    api = MapApi(url)
    if made:
        push_prior_data(api, MAP, str(made))
    else:
        api.create_map(MAP, CreateMap(geometry=geometry))
    scout = _robot(url, "scout")
    for n, diff in enumerate(diffs):
        scout.push(MAP, make_commit(meta_of("scout", n, geometry), diff, geometry))
    wait_until_folded(api, MAP)


def _robot(url: str, name: str) -> MapApi:
    robot = MapApi(url)
    robot.register(MAP, Register(robot=name, incarnation="0" * 16))
    return robot


@contextmanager
def _page(chromium: Browser, url: str, name: str) -> Iterator[Console]:
    """A tab of a browser that has nothing from before."""
    with chromium.new_context(viewport=VIEW) as context:
        context.add_init_script(WATCH)
        console = Console(context.new_page(), None)
        console.page.goto(f"{url}/?test=1#map={name}")
        yield console


def _pictures(chromium: Browser, url: str) -> tuple[Drawn, Drawn]:
    """The first picture of the map, and the finest."""
    with _page(chromium, url, MAP) as console:
        first, finest = console.page.evaluate("() => window.pictures")
    return Drawn(**first), Drawn(**finest)


def _picture_rows(what: str, found: list[tuple[Drawn, Drawn]]) -> Iterator[Row]:
    first, finest = zip(*found, strict=True)
    for name, goals, drawn in (
        (f"first picture of {what}", ("; below 2000 is asked for", "; at most 500 are asked for"), first),
        ("  as fine as it gets", ("", ""), finest),
    ):
        ms = [each.ms for each in drawn]
        yield name, f"{statistics.median(ms):.0f}", f"ms, at most {max(ms):.0f}{goals[0]}"
        size = f"kB, {drawn[0].nodes} nodes of {drawn[0].cells} cells{goals[1]}"
        yield "    of it", f"{statistics.median(each.bytes for each in drawn) / 1e3:.0f}", size


def _leaf_rows(url: str, geometry: Geometry) -> Iterator[Row]:
    size_bytes = voxels = 0
    with httpx.Client(base_url=url, timeout=60, headers={"Accept-Encoding": "gzip"}) as http:
        for entry in MapApi(url).cell_index(MAP).cells:
            cell = ",".join(map(str, entry.cell))
            path = f"/maps/{MAP}/main/cells/{cell}.view"
            with http.stream("GET", path, params={"depth": geometry.depth}) as answer:
                answer.raise_for_status()
                body = answer.read()
                size_bytes += answer.num_bytes_downloaded
            voxels += len(decode_view(body).view.nodes)
    yield (
        "the whole map, voxel by voxel",
        f"{size_bytes / voxels:.2f}",
        f"B a voxel of {voxels}; at most 5 are asked for",
    )


def _push_rows(chromium: Browser, url: str, geometry: Geometry, diff: Diff, repeats: int) -> Iterator[Row]:
    """From where a robot begins to push until the picture has it."""
    mole = _robot(url, "mole")
    total_ms, frame_ms = [], []
    with _page(chromium, url, MAP) as console:
        console.page.evaluate("() => window.pictures")
        for n in range(repeats):
            console.until("!c.cells.isFresh", "nothing pulses")
            frame_ms.append(console.page.evaluate(FRAME))
            console.page.evaluate(NEXT, [console.tell("c.cells.head")])
            commit = make_commit(meta_of("mole", n, geometry), diff, geometry)
            start_s = time.time()
            mole.push(MAP, commit)
            total_ms.append(console.page.evaluate("() => window.next")["time_ms"] - 1e3 * start_s)
    frame = statistics.median(frame_ms)
    yield (
        f"commit pushed, {len(diff)} cells: drawn after",
        f"{statistics.median(total_ms):.0f}",
        f"ms, at most {max(total_ms):.0f}",
    )
    beside = sorted(ms - frame for ms in total_ms)
    goal = f"ms, at most {beside[-1]:.0f}; below 1000 is asked for"
    yield f"  beside the frame itself, which takes {frame:.0f} ms", f"{statistics.median(beside):.0f}", goal
