"""Three simulated robots build one map through a real server, and prove that they all hold the same.

    $ cairn demo
    ...
    all equal: server, scout, mole and late hold the same 12 cells, byte for byte

It starts a server on a free port of this machine, lets three robots with different cameras drive through a
simulated building in which a door opens and people come and go (one robot loses its link for a while, one joins late
and is low-end), shows who has what, compares every cell of every map, takes one commit out again and compares with a
map that never had it. The result lies in ./demo: map.ply for a point cloud viewer, map.png to look at, and the server's
data to serve again.

    $ cairn demo --yard
    ...
    all equal: server, rover and mole hold the same 48 cells of 2 layers, byte for byte, from 46 commits

That is the same for a hybrid map: a yard of 40 m as a level, the shed in it as evidence of 4 cm, and two robots that
cross its door, one inwards, one outwards, and map into the layer of the place where they are. The ground is compared
with the truth: in the open, in high grass, below a bridge, and where a person stood.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.table import Table

from cairn_client.cli.arguments import parser, shown_bytes
from cairn_client.http.api import MapApi
from cairn_fusion.view.picture import write_map_picture
from cairn_map.epochs.epoch import STANDARD_EPOCH_S
from cairn_map.epochs.present import shown_evidence
from cairn_map.evidence.grid import geometry_for
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import joined_voxels, voxels_of_evidence
from cairn_map.files.cell_files import ply_file
from cairn_map.wire.messages import BranchInfo, CreateMap, Retract
from cairn_sim.demo.check import (
    bring_level,
    map_identity,
    map_without,
    require_equal,
    server_identity,
    wait_for_fold,
)
from cairn_sim.demo.robot import STOP_S, DemoDrive, DemoRobot
from cairn_sim.demo.stage import demo_server, empty_folder
from cairn_sim.demo.yard import show_yard
from cairn_sim.robots.heads import colour_and_tof_head, full_head, thermal_and_tof_head
from cairn_sim.robots.trajectories import stops
from cairn_sim.scene.scene import Scene
from cairn_sim.scene.scene_file import load_scene

MAP = "building"
IMAGE_SCALE = 0.25
"""Colour and thermal images a quarter as wide: enough for voxels of 4 cm, and quickly rendered."""
CEILING_M = 0.9
"""Height at which the picture cuts the map: over the heads, under the ceiling's 1.7 m."""
QUICK_SCANS = (4, 1)
"""Yaws and pitches of `--quick`: the same story with a poorer map."""
YARD_SCANS = (8, 3)


def plans(scene: Scene) -> list[DemoDrive]:
    """The team: the first maps everything, the second goes offline, the third is low-end and joins late."""
    return [
        DemoDrive(
            name="scout",
            head="2 colour, 2 thermal, ToF",
            rig=full_head(scale=IMAGE_SCALE),
            stops=stops(scene, "labs")[1:24:3],
            mode="high-end",
        ),
        DemoDrive(
            name="mole",
            head="thermal, ToF",
            rig=thermal_and_tof_head(scale=IMAGE_SCALE),
            stops=stops(scene, "corridors")[6:13],
            mode="high-end",
            starts_after=1,
            offline=(2, 3, 4),
        ),
        DemoDrive(
            name="late",
            head="colour, ToF",
            rig=colour_and_tof_head(scale=IMAGE_SCALE),
            stops=stops(scene, "corridors")[17:27:2],
            mode="low-end",
            starts_after=3,
        ),
    ]


def main(argv: list[str]) -> int:
    """Run the demo; 0 only if every check held."""
    args = _parser().parse_args(argv)
    console = Console()
    empty_folder(args.output)
    if args.yard:
        scans = QUICK_SCANS if args.quick else YARD_SCANS
        return show_yard(args.output, console, voxel_edge_m=args.voxel, seed=args.seed, scans=scans)
    start_s = time.monotonic()
    with demo_server(args.output / "server") as url:
        console.print(f"server on {url}, its data in {args.output / 'server'}")
        api = MapApi(url)
        api.create_map(MAP, CreateMap(geometry=geometry_for(voxel_edge_m=args.voxel), epoch_s=STANDARD_EPOCH_S))
        scene = load_scene("moving-building")
        map_url = f"{url}/maps/{MAP}"
        chosen = [replace(plan, scans=QUICK_SCANS) if args.quick else plan for plan in plans(scene)]
        team = [DemoRobot(plan, scene, map_url, args.output / "robots", args.seed + n) for n, plan in enumerate(chosen)]
        for member in team:
            console.print(f"  {member.plan.name}: {member.plan.head}; {member.plan.mode}, {member.stop_count} stops")
        moving = ", ".join(each.name for each in scene.moving)
        console.print(f"  in the building move: {moving}; stops are {STOP_S:.0f} s apart")
        try:
            _drive(team, api, console)
            _check(team, api, console)
            _retract(team, api, console)
            _write(team[0], args.output, console)
        finally:
            for member in team:
                member.close()
    console.print(f"\ndone in {time.monotonic() - start_s:.0f} s. What to do next:")
    console.print(f"  look at {args.output / 'map.png'}, or open {args.output / 'map.ply'} in a point cloud viewer")
    console.print(f"  cairn serve --data {args.output / 'server'}, and open http://127.0.0.1:8750/ in a browser:")
    console.print("    turn the map, slice it, click it")
    console.print(f"  cairn map info http://127.0.0.1:8750/maps/{MAP}, in another terminal")
    console.print("  cairn robot replay --help: map a recording of your own")
    return 0


def _drive(team: Sequence[DemoRobot], api: MapApi, console: Console) -> None:
    """Let the robots map until all arrived; show the table."""
    for member in team:
        member.start()
    with Live(console=console, refresh_per_second=4) as live:
        while not all(member.is_done for member in team):
            for member in team:
                if team[0].progress.commits >= member.plan.starts_after:
                    member.may_start.set()
            live.update(_table(team, api.branches(MAP)))
            time.sleep(0.25)
        for member in team:
            if member.error is not None:
                raise member.error
        bring_level([member.robot for member in team], api, MAP)
        for member in team:
            member.sync()
        live.update(_table(team, api.branches(MAP)))
    console.print()


def _table(team: Sequence[DemoRobot], branches: Sequence[BranchInfo]) -> Table:
    behind = {branch.branch: branch.behind for branch in branches}
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for title in ("robot", "mode", "state", "commits", "up", "down", "cells", "map"):
        table.add_column(title, no_wrap=True, justify="left" if title in ("robot", "mode", "state") else "right")
    for member in team:
        now = member.progress
        lag = behind.get(member.plan.name)
        level = "-" if lag is None else ("level" if lag == 0 else f"{lag} behind")
        state = now.state + (f", {now.waiting} wait" if now.waiting else "")
        table.add_row(
            member.plan.name,
            member.plan.mode,
            state,
            f"{now.commits}/{member.stop_count}",
            shown_bytes(now.up_bytes),
            shown_bytes(now.down_bytes),
            str(now.cells),
            level,
        )
    return table


def _check(team: Sequence[DemoRobot], api: MapApi, console: Console) -> None:
    identities = {"the server": server_identity(api, MAP)}
    identities |= {member.plan.name: map_identity(member.robot.map) for member in team}
    count = require_equal(identities)
    commits = sum(member.progress.commits for member in team)
    console.print(
        f"[green]all equal[/]: server, {', '.join(m.plan.name for m in team)} hold the same {count} cells, "
        f"byte for byte, from {commits} commits in whatever order they came"
    )


def _retract(team: Sequence[DemoRobot], api: MapApi, console: Console) -> None:
    """Take one of the second robot's commits out, and compare with a map that never had it."""
    robots = [member.robot for member in team]
    target = next(iter(team[1].robot.replica.commits))
    done = api.retract(MAP, Retract(commits=[str(target)], note="demo"))
    wait_for_fold(api, MAP, lambda ids: done.id in ids)
    bring_level(robots, api, MAP)
    identities = {"a map that never had it": map_identity(map_without(robots, target))}
    identities["the server"] = server_identity(api, MAP)
    identities |= {member.plan.name: map_identity(member.robot.map) for member in team}
    require_equal(identities)
    console.print(f"[green]retracted[/] {target}: every map equals one that never had it")


def _write(member: DemoRobot, folder: Path, console: Console) -> None:
    view = member.robot.map
    model = SensorModel()
    cells = {key: shown_evidence(view.history(key), view.layer, model) for key in view}
    voxels = joined_voxels(
        [voxels_of_evidence(key, cell, view.geometry, model, occupied_only=True) for key, cell in cells.items()]
    )
    (folder / "map.ply").write_bytes(ply_file(voxels))
    write_map_picture(folder / "map.png", voxels, voxel_edge_m=view.geometry.voxel_edge_m, ceiling_m=CEILING_M)
    console.print(f"wrote {folder / 'map.ply'} and {folder / 'map.png'}: {len(voxels)} occupied voxels")


def _parser() -> argparse.ArgumentParser:
    options = parser("cairn demo", __doc__)
    options.add_argument(
        "--output", type=Path, default=Path("demo"), metavar="DIR", help="where the result goes (demo)"
    )
    options.add_argument("--voxel", type=float, default=0.04, metavar="METRES", help="voxel edge (0.04)")
    options.add_argument("--yard", action="store_true", help="a yard as a level and its shed as evidence: one map")
    options.add_argument("--quick", action="store_true", help="fewer scans at each stop: a poorer map, sooner")
    options.add_argument("--seed", type=int, default=1, help="of the cameras' noise (1)")
    return options
