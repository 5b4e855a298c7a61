"""How fast the map is drawn: over a live image, at 4 and 2 cm, and by a server, with cold cells and with warm ones.

With --smoke the map is one stop at 8 cm. Frames are those of a robot without a thermal camera, 640 x 480. A view is
cold where the server, which has drawn others, has none of its cells in memory.
"""

import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import httpx
import numpy as np
import numpy.typing as npt
from tests.bench.building import building_map, wait_until_folded
from tests.fixtures.server.live import Process

from cairn_calib.rig.rig import Rig
from cairn_client.cli.maps.create import push_prior_data
from cairn_client.cli.maps.overlay_drawing import MapOverlay
from cairn_client.folders.map_folder import FolderMap, map_of_folder
from cairn_client.http.api import MapApi
from cairn_fusion.image_fusion.mirror_labels import mirror_pixels
from cairn_fusion.image_fusion.surface import live_range
from cairn_fusion.recording.scan import Scan
from cairn_fusion.view.overlay import Live, OverlayStyle, draw_overlay
from cairn_map.queries.map_snapshot import MapSnapshot
from cairn_map.render.camera_rays import CameraRays
from cairn_map.render.map_render import MapRenderer
from cairn_map.render.render_request import RenderRequest, request_from
from cairn_sim.robots.record import Plan, scans_of, shots_of
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

Row = tuple[str, str, str]
THREADS = 2
CAMERA = "colour"
SCALE = 1.0
"""Of the handheld robot's colour camera: 640 x 480."""


def overlay_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    rig, scans = _frames(2 if smoke else 6)
    with tempfile.TemporaryDirectory() as name:
        for cm, least in ((8, ""),) if smoke else ((4, "25"), (2, "10")):
            folder = building_map(Path(name), cm, stops=1 if smoke else None)
            known = map_of_folder(folder)
            snapshot = known.snapshot
            yield (
                f"overlay of {len(snapshot.frozen.keys)} cells, {cm} cm",
                f"{len(snapshot.frozen.grid.words)}",
                "bricks",
            )
            yield from _overlay_rows(snapshot, rig, scans, least, repeats=2 if smoke else 5)
            yield from _stream_rows(known, rig, scans, least, repeats=2 if smoke else 5)
            if cm != 2:
                yield from _server_rows(folder, rig, scans)


def _frames(count: int) -> tuple[Rig, list[Scan]]:
    """What a robot without a thermal camera sees at stops of the first path."""
    robot = ROBOTS["handheld"]
    plan = Plan(scene=load_scene("building"), robot=robot, path="labs", scale=SCALE, truth="none")
    rig, shots = robot.rig_of(plan.scale), shots_of(plan)
    chosen = shots[:: max(1, len(shots) // count)][:count]
    return rig, [scan for _, scan, _ in scans_of(plan, chosen, rig)]


def _overlay_rows(snapshot: MapSnapshot, rig: Rig, scans: Sequence[Scan], least: str, *, repeats: int) -> Iterator[Row]:
    renderer, style = MapRenderer(threads=THREADS), OverlayStyle()
    sight = CameraRays(rig[CAMERA].camera.rays())
    lives = [
        Live(
            rgb=scan.colour[CAMERA],
            range_m=live_range(scan, rig, camera=CAMERA),
            sight=sight,
            T_map_camera=scan.T_map_rig @ rig[CAMERA].transform,
        )
        for scan in scans
    ]
    for live in lives:
        draw_overlay(renderer, snapshot, live, style)
    start_s = time.perf_counter()
    for _ in range(repeats):
        for live in lives:
            draw_overlay(renderer, snapshot, live, style)
    seconds = (time.perf_counter() - start_s) / (repeats * len(lives))
    size, goal = f"{sight.width} x {sight.height}", f"; at least {least} are asked for" if least else ""
    yield f"  over a live image, {size}", f"{1 / seconds:.1f}", f"frames/s, {THREADS} threads{goal}"
    start_s = time.perf_counter()
    for live in lives:
        renderer.nearest(snapshot, sight, live.T_map_camera, range_max_m=20)
    seconds = (time.perf_counter() - start_s) / len(lives)
    yield "  the nearest of each pixel alone", f"{1e3 * seconds:.0f}", "ms"


def _stream_rows(known: FolderMap, rig: Rig, scans: Sequence[Scan], least: str, *, repeats: int) -> Iterator[Row]:
    """From scan to picture, as `cairn telepresence --mode map` does it: the colour camera's depth is found, too."""
    overlay = MapOverlay(rig=rig, map=known, style=OverlayStyle(), camera=CAMERA)
    for scan in scans:
        overlay.view(scan)
    seconds = _mean_s(overlay.view, scans, repeats=repeats)
    goal = f"; at least {least} are asked for" if least else ""
    yield "  from scan to picture", f"{1 / seconds:.1f}", f"frames/s, {THREADS} threads{goal}"
    renderer, snapshot = overlay.renderer, known.snapshot
    seconds = _mean_s(lambda scan: mirror_pixels(scan, rig, snapshot, renderer=renderer), scans, repeats=repeats)
    yield "    what mirrors show", f"{1e3 * seconds:.1f}", "ms of it"
    seconds = _mean_s(lambda scan: live_range(scan, rig, camera=CAMERA), scans, repeats=repeats)
    yield "    the colour camera's depth", f"{1e3 * seconds:.1f}", "ms of it"


def _mean_s(work: Callable[[Scan], object], scans: Sequence[Scan], *, repeats: int) -> float:
    start_s = time.perf_counter()
    for _ in range(repeats):
        for scan in scans:
            work(scan)
    return (time.perf_counter() - start_s) / (repeats * len(scans))


def _server_rows(folder: Path, rig: Rig, scans: Sequence[Scan]) -> Iterator[Row]:
    """Views from where the frames were taken, along the path: each has cells that the ones before had not."""
    with tempfile.TemporaryDirectory() as data:
        server = Process(Path(data))
        try:
            assert server.url
            api = MapApi(server.url)
            push_prior_data(api, "lab", str(folder))
            wait_until_folded(api, "lab")
            views = [_view(scan.T_map_rig @ rig[CAMERA].transform) for scan in scans]
            cold_s, warm_s = [], []
            with httpx.Client(base_url=server.url, timeout=60) as http:
                for view in views:
                    cold_s.append(_ask_s(http, view))
                    warm_s += [_ask_s(http, view) for _ in range(3)]
            some = cold_s[1:] or cold_s  # with the first the kernels are loaded
            yield (
                "  a server's view, cold cells",
                f"{1e3 * statistics.median(some):.0f}",
                f"ms, at most {1e3 * max(some):.0f}; below 1000 is asked for",
            )
            yield (
                "  a server's view, warm",
                f"{1e3 * statistics.median(warm_s):.0f}",
                f"ms, at most {1e3 * max(warm_s):.0f}; below 200 is asked for",
            )
        finally:
            server.send(signal.SIGTERM)
            server.end()


def _view(T_map_camera: npt.NDArray[np.float64]) -> RenderRequest:
    x, y, z = T_map_camera[:3, 3].tolist()
    ahead = (T_map_camera[:3, 3] + T_map_camera[:3, 2]).tolist()
    return request_from((x, y, z), (ahead[0], ahead[1], ahead[2]))


def _ask_s(http: httpx.Client, view: RenderRequest) -> float:
    start_s = time.perf_counter()
    http.get("/maps/lab/main/render", params=view.model_dump(mode="json", exclude_none=True)).raise_for_status()
    return time.perf_counter() - start_s
