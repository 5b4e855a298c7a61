"""What must hold when the links are good again: one map, of all commits, each of them once."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.fixtures.server.live import until
from tests.links.life import LOG, MAP, Building, open_robot

from cairn_client.http.api import MapApi
from cairn_client.http.http_link import index_of
from cairn_client.robot.robot import Robot
from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits.commit import split_commit
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import Cell, cell_key

LOG_PAGE = 1000
Cells = dict[int, bytes]


@dataclass(slots=True)
class Verdict:
    """What is wrong, if anything."""

    commits: int = 0
    """In the map."""
    cells: int = 0
    wrong: list[str] = field(default_factory=list)


def verdict_on(port: int, folder: Path, names: list[str], building: Building) -> Verdict:
    """Open the robots' folders, let them sync over a good link, and compare all there is."""
    found = Verdict()
    with MapApi(f"http://127.0.0.1:{port}") as api:
        robots = [open_robot(port, folder, name, building) for name in names]
        try:
            for robot in robots:
                _sync(robot, found)
            until(lambda: not api.cell_index(MAP).header.pending, "everything is folded")
            for robot in robots:
                _sync(robot, found)
            _compare(api, robots, folder, building, found)
        finally:
            for robot in robots:
                robot.close()
    return found


def _sync(robot: Robot, found: Verdict) -> None:
    report = robot.sync()
    while report.has_more:
        report = robot.sync()
    found.wrong += [f"{robot.name}: {commit} was refused" for commit in report.refused]
    if robot.waiting:
        found.wrong.append(f"{robot.name}: {robot.waiting} commits wait")


def _compare(api: MapApi, robots: list[Robot], folder: Path, building: Building, found: Verdict) -> None:
    folded = Counter(_folded(api))
    found.commits = len(folded)
    found.wrong += [f"{name} is in the log {count} times" for name, count in folded.items() if count > 1]
    for robot in robots:
        written = (folder / robot.name / LOG).read_text().splitlines()
        found.wrong += [f"{name} is lost" for name in written if name not in folded]
        numbers = sorted(commit_id_from_text(name).n for name in folded if name.startswith(f"{robot.name}."))
        if numbers != list(range(len(numbers))):
            found.wrong.append(f"{robot.name}: commits {numbers} are in the map")
    expected = _sum_of(api, folded, building)
    found.cells = len(expected)
    maps = {robot.name: _cells_of(robot.map) for robot in robots}
    maps["server"] = {
        cell_key(entry.cell): api.cell(MAP, Cell(*entry.cell)).body or b""
        for entry in index_of(api, MAP).cells
        if entry.voxels
    }
    for name, cells in maps.items():
        different = [key for key in expected.keys() | cells.keys() if expected.get(key) != cells.get(key)]
        if different:
            found.wrong.append(f"{name}: {len(different)} of {len(expected)} cells are others than the sum of commits")


def _folded(api: MapApi) -> list[str]:
    names: list[str] = []
    after = 0
    while page := api.log(MAP, after=after, limit=LOG_PAGE):
        names += [entry.id for entry in page]
        after = page[-1].seq
    return names


def _sum_of(api: MapApi, folded: Counter[str], building: Building) -> Cells:
    total = EvidenceMap(building.geometry)
    for name in folded:
        meta, _ = split_commit(api.commit(MAP, commit_id_from_text(name))[0])
        total.merge(building.diffs[int(meta.note)])
    return _cells_of(total)


def _cells_of(view: EvidenceMap) -> Cells:
    packed = view.packed().items()
    return {key: encode_cell(key, evidence, view.geometry).data for key, evidence in packed if len(evidence)}
