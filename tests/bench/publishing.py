"""A map on its way to Nav2 and Foxglove: the building's floor, and how soon a viewer has a change.

The building is mapped at 4 cm by all robots (`CAIRN_OVERLAY_MAPS` spares its eight minutes; one stop with --smoke). A
change is one scan of a stop in its laboratories, pushed to a server of its own process; `cairn map publish --foxglove`
runs in this process, and the viewer speaks the protocol over loopback. Counted from the acknowledgement of the push,
so the fold is in it.
"""

import signal
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.bench.building import building_map, wait_until_folded
from tests.bench.pushing import meta_of
from tests.bench.server import scan_diffs
from tests.bench.timing import wall_s
from tests.fixtures.client.foxglove_viewer import FoxgloveViewer
from tests.fixtures.server.live import Process, free_port

from cairn_client.cli.maps.command import main as map_command
from cairn_client.cli.maps.create import push_prior_data
from cairn_client.folders.map_folder import open_map
from cairn_client.http.api import MapApi
from cairn_map.commits.commit import make_commit
from cairn_map.render.map_server import pgm_of
from cairn_map.wire.messages import Register

Row = tuple[str, str, str]
MAP = "building"
JOIN_S = 300.0


def publishing_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    with tempfile.TemporaryDirectory() as name:
        folder = building_map(Path(name), 4, stops=1 if smoke else None)
        snapshot = open_map(folder)
        repeats = 3 if smoke else 20
        ground_m, free_m2 = snapshot.grounds()[0]
        grid = snapshot.floor_grid(ground_m=ground_m)
        H, W = grid.values.shape
        yield "floor of the building, 4 cm", f"{W} x {H}", f"pixels, {free_m2:.0f} m2 free at {ground_m:.2f} m"
        works: tuple[tuple[str, Callable[[], object]], ...] = (
            ("its grid, once read", lambda: snapshot.floor_grid(ground_m=ground_m)),
            ("its storeys' grounds", snapshot.grounds),
            ("its picture for map servers", lambda: pgm_of(grid)),
        )
        for what, work in works:
            yield f"  {what}", f"{1e3 * wall_s(work, repeats):.1f}", "ms"
        yield from _change_rows(folder, Path(name) / "server", ground_m=ground_m, changes=3 if smoke else 30)


def _change_rows(folder: Path, data: Path, *, ground_m: float, changes: int) -> Iterator[Row]:
    server = Process(data)
    try:
        assert server.url
        with MapApi(server.url) as api:
            push_prior_data(api, MAP, str(folder))
            wait_until_folded(api, MAP)
            geometry = api.map_info(MAP).geometry
            diffs = scan_diffs("orpheus", geometry, scale=0.25, scans=4)
            port = free_port("127.0.0.1")
            words = ["publish", f"{server.url}/maps/{MAP}", "--foxglove", str(port), f"--ground={ground_m}"]
            words.append(f"--changes={changes + 1}")
            publishing = threading.Thread(target=map_command, args=(words,), daemon=True)
            publishing.start()
            seconds = []
            with _joined(port) as viewer, MapApi(server.url) as robot:
                viewer.subscribe("/map")
                viewer.next_data()
                robot.register(MAP, Register(robot="scout", incarnation="0" * 16))
                for n in range(changes):
                    commit = make_commit(meta_of("scout", n, geometry), diffs[n % len(diffs)], geometry)
                    robot.push(MAP, commit)
                    start_s = time.perf_counter()
                    viewer.next_data()
                    seconds.append(time.perf_counter() - start_s)
            publishing.join()
    finally:
        server.send(signal.SIGTERM)
        server.end()
    yield "  a change's floor at a viewer", f"{1e3 * statistics.median(seconds):.0f}", "ms after the push, median"
    yield "  ... at the latest", f"{1e3 * max(seconds):.0f}", "ms"


def _joined(port: int) -> FoxgloveViewer:
    until_s = time.monotonic() + JOIN_S
    while True:
        try:
            return FoxgloveViewer(f"ws://127.0.0.1:{port}", wait_s=JOIN_S)
        except ConnectionRefusedError:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.05)
