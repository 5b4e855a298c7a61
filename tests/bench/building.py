"""The whole building's map, 56 cells at 4 cm, which benches look at.

It takes some 8 minutes to make; where CAIRN_OVERLAY_MAPS names a folder with `orpheus-4cm` and `orpheus-2cm` in it, as
`cairn map export --cells` writes them, these are taken instead.
"""

import os
import time
from pathlib import Path

from cairn_client.http.api import MapApi
from cairn_map.codec.cell_code import encode_cell
from cairn_map.evidence.grid import cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.cell_folder import FolderHead, write_cell, write_head
from cairn_sim.experiment.figures import paper_geometry
from cairn_sim.experiment.mapping import GrowingMap, map_all
from cairn_sim.experiment.robots import simulated_robots
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene

THREADS = 2
FOLDED_S = 120.0


def building_map(inside: Path, cm: int, *, stops: int | None) -> Path:
    """The map as a folder of cells, made in a folder from so many stops of each robot, or the one that is there."""
    made = os.environ.get("CAIRN_OVERLAY_MAPS")
    if made and (Path(made) / f"orpheus-{cm}cm").is_dir():
        return Path(made) / f"orpheus-{cm}cm"
    robots = simulated_robots(
        load_scene("building"), ROBOTS["orpheus"], scale=0.25, seed=0, stops=stops, threads=THREADS
    )
    growing = GrowingMap(paper_geometry(cm / 100))
    for _ in map_all(robots, [growing], threads=THREADS):
        pass
    folder = inside / f"{cm}cm"
    write_head(folder, FolderHead(geometry=growing.geometry, sensor_model=SensorModel()))
    for key, evidence in growing.map.packed().items():
        write_cell(folder, cell_of_key(key), encode_cell(key, evidence, growing.geometry).data)
    return folder


def wait_until_folded(api: MapApi, name: str) -> None:
    """Return when a map has all that was pushed."""
    until_s = time.monotonic() + FOLDED_S
    while api.cell_index(name).header.pending and time.monotonic() < until_s:
        time.sleep(0.05)
