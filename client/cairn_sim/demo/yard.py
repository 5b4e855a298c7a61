"""The demo's yard: a hybrid map of a level outdoors and evidence in the shed, and its heights against the truth.

    rover    a lidar; goes round the yard, then in through the shed's door
    mole     all cameras; begins in the shed, and comes out

Each maps into the layer of the place where it is, and fetches both.
"""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.table import Table

from cairn_client.cli.arguments import shown_bytes
from cairn_client.http.api import MapApi
from cairn_fusion.view.picture import write_map_picture
from cairn_map.epochs.epoch import STANDARD_EPOCH_S
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import geometry_for, level_geometry
from cairn_map.files.cell_files import ply_file
from cairn_map.queries.level.elevation import Elevation
from cairn_map.render.elevation_picture import elevation_npz, elevation_png
from cairn_map.wire.layer_messages import AddLayer
from cairn_map.wire.messages import CreateMap
from cairn_sim.demo.check import bring_level, map_identity, require_equal, server_identity
from cairn_sim.demo.stage import demo_server
from cairn_sim.demo.yard_robot import GROUND, YardRobot
from cairn_sim.evaluation.ground_truth import GroundErrors, ground_errors, ground_errors_below
from cairn_sim.robots.record import Plan
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.movements import CLOCK_START_S
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import load_scene

MAP = "yard"
LAYERS = {EVIDENCE: MAP, GROUND: f"{MAP}.{GROUND}"}
"""Layers of the map, and the names under which a server has them."""
SCENE = "bridge-yard"
LASTS_S = 1800.0
"""Time of either way, in the scene's time, which passes at once: someone waits on the meadow for a third of it."""
IMAGE_SCALE = 0.25
CUT_M = 0.7
"""Height at which the picture cuts the shed: under its roof."""
GRASS = "high grass"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """Errors that the ground may have at a kind of place."""

    place: str
    median_m: float = 0.02
    largest_m: float = np.inf
    within_three: float = 0.0
    """Share of the columns whose error is within three sigma, at least."""

    def is_kept(self, errors: GroundErrors) -> bool:
        """True if there are columns, and none of the three is broken."""
        return (
            len(errors.error_m) > 0
            and errors.median_m <= self.median_m
            and errors.largest_m <= self.largest_m
            and errors.within_three >= self.within_three
        )


OPEN = Bound(place="open ground", within_three=0.99)
BELOW = {
    "pipe bridge/deck": Bound(place="below the bridge", largest_m=0.12),
    GRASS: Bound(place="in high grass", median_m=0.03, largest_m=0.12),
    "waiting": Bound(place="where a person stood", largest_m=0.12),
}
"""By what is above the ground."""


def show_yard(
    folder: Path, console: Console, *, voxel_edge_m: float = 0.04, seed: int = 1, scans: tuple[int, int] = (8, 3)
) -> int:
    """Run the demo of the yard; 0 only if every check held.

    Args:
        folder: empty, for what it leaves.
        console: for what it says.
        voxel_edge_m: of the evidence in the shed.
        seed: of the sensors' noise.
        scans: pans and tilts of the cameras at each stop.

    Raises:
        CairnError: two maps differ, the ground is not as it should be, or the server failed.
    """
    start_s, scene = time.monotonic(), load_scene(SCENE)
    with demo_server(folder / "server") as url, MapApi(url) as api, ExitStack() as opened:
        console.print(f"server on {url}, its data in {folder / 'server'}")
        api.create_map(MAP, CreateMap(geometry=geometry_for(voxel_edge_m=voxel_edge_m), epoch_s=STANDARD_EPOCH_S))
        level = level_geometry()
        api.add_layer(MAP, AddLayer(name=GROUND, geometry=level, epoch_s=STANDARD_EPOCH_S))
        console.print(
            f"map {MAP}: evidence of {voxel_edge_m * 100:g} cm for the shed, and layer {GROUND}, a level: "
            f"columns of {level.voxel_edge_m * 100:g} cm, bins of {level.voxel_height_m * 100:g} cm"
        )
        team: list[YardRobot] = []
        for name, plan in yard_plans(scene, seed, scans).items():
            member = YardRobot(name, plan, f"{url}/maps/{MAP}", folder / "robots")
            opened.callback(member.close)
            team.append(member)
            console.print(f"  {member.name}: {member.plan.robot.about}; {member.stop_count} stops")
        drive_team(team, api, console)
        require_equal_maps(team, api, console)
        ground = team[0].robot.snapshot()[GROUND].elevation()
        require_true_ground(scene, ground, console)
        _write(team[0], ground, folder, console)
    console.print(f"\ndone in {time.monotonic() - start_s:.0f} s. What to do next:")
    console.print(
        f"  look at {folder / 'ground.png'} and {folder / 'map.png'}, or open {folder / 'map.ply'} in a viewer"
    )
    console.print(f"  cairn serve --data {folder / 'server'}, and in another terminal")
    for name in LAYERS.values():
        console.print(f"  cairn map info http://127.0.0.1:8750/maps/{name}")
    return 0


def yard_plans(scene: Scene, seed: int, scans: tuple[int, int]) -> dict[str, Plan]:
    """Ways of the robots, by name."""
    cameras = replace(ROBOTS["orpheus"], scans=scans, about="2 colour, 2 thermal, 1 ToF camera on a manipulator")
    rover = Plan(scene=scene, robot=ROBOTS["lidar"], path="round", truth="none", lasts_s=LASTS_S, seed=seed)
    return {
        "rover": rover,
        "mole": replace(rover, robot=cameras, path="out", scale=IMAGE_SCALE, seed=seed + 1),
    }


def drive_team(team: Sequence[YardRobot], api: MapApi, console: Console) -> None:
    """Let the robots measure in turn until all arrived and have all of the map; show the table.

    Raises:
        CairnError: as `YardRobot.measure`; the server did not fold all commits.
    """
    with Live(console=console, refresh_per_second=4) as live:
        driving = list(team)
        while driving:
            driving = [member for member in driving if member.measure()]
            live.update(_table(team))
        for layer, name in LAYERS.items():
            bring_level([member.robot.robots[layer] for member in team], api, name)
        for member in team:
            member.sync()
        live.update(_table(team))
    console.print()


def _table(team: Sequence[YardRobot]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("robot", "place", "stops", "up", "down", *LAYERS):
        table.add_column(title, no_wrap=True, justify="left" if title in ("robot", "place") else "right")
    for member in team:
        now = member.progress
        table.add_row(
            member.name,
            now.place,
            f"{now.stops}/{member.stop_count}",
            shown_bytes(now.up_bytes),
            shown_bytes(now.down_bytes),
            *(f"{len(member.robot.robots[layer].map)} cells" for layer in LAYERS),
        )
    return table


def require_equal_maps(team: Sequence[YardRobot], api: MapApi, console: Console) -> None:
    """Refuse layers that differ between the server and the robots.

    Raises:
        DamagedDataError: kind `maps_differ`, naming the two.
    """
    count = 0
    for layer, name in LAYERS.items():
        identities = {"the server": server_identity(api, name)}
        identities |= {member.name: map_identity(member.robot.robots[layer].map) for member in team}
        count += require_equal(identities)
    commits = sum(member.progress.commits for member in team)
    console.print(
        f"[green]all equal[/]: server, {' and '.join(m.name for m in team)} hold the same {count} cells "
        f"of {len(LAYERS)} layers, byte for byte, from {commits} commits"
    )


def require_true_ground(scene: Scene, ground: Elevation, console: Console) -> None:
    """Refuse a level whose heights are not the scene's.

    Raises:
        DamagedDataError: kind `ground_wrong`, naming the place and its errors.
    """
    free = scene.at(CLOCK_START_S + LASTS_S)
    found = [(OPEN, ground_errors(free, ground, without=(GRASS,)))]
    found += [(bound, ground_errors_below(scene, ground, name)) for name, bound in BELOW.items()]
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("ground against the truth", "columns", "median", "largest", "within 3 sigma"):
        table.add_column(title, no_wrap=True, justify="left" if not table.columns else "right")
    for bound, errors in found:
        if not bound.is_kept(errors):
            raise DamagedDataError(
                "ground_wrong",
                f"{bound.place}: expected {bound}, got {len(errors.error_m)} columns, median "
                f"{errors.median_m:.3f} m, largest {errors.largest_m:.3f} m, {errors.within_three:.1%} within 3 sigma",
            )
        table.add_row(
            bound.place,
            str(len(errors.error_m)),
            f"{errors.median_m * 100:.1f} cm",
            f"{errors.largest_m * 100:.1f} cm",
            f"{errors.within_three:.1%}",
        )
    console.print(table)


def _write(member: YardRobot, ground: Elevation, folder: Path, console: Console) -> None:
    shed = member.robot.snapshot()[EVIDENCE]
    voxels = shed.occupied_in()
    write_map_picture(folder / "map.png", voxels, voxel_edge_m=shed.geometry.voxel_edge_m, ceiling_m=CUT_M)
    (folder / "map.ply").write_bytes(ply_file(voxels))
    (folder / "ground.png").write_bytes(elevation_png(ground))
    (folder / "ground.npz").write_bytes(elevation_npz(ground))
    known = int(np.isfinite(ground.height_m).sum())
    console.print(f"wrote {folder / 'map.png'} and {folder / 'map.ply'}: {len(voxels)} occupied voxels of the shed")
    console.print(
        f"wrote {folder / 'ground.png'} and {folder / 'ground.npz'}: {known} columns of ground, how hard to pass"
    )
