"""One robot in a process of its own: it maps and syncs until somebody kills it."""

import logging
import pickle
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from tests.bench.pushing import Diff, facts_of

from cairn_client.robot.robot import Robot
from cairn_client.sync.link_profile import LinkName
from cairn_map.evidence.grid import Geometry

MAP = "building"
LOG = "committed.txt"
SYNC_EVERY_S = 0.2


@dataclass(frozen=True, slots=True)
class Building:
    """What robots see."""

    geometry: Geometry
    diffs: list[Diff]
    scans: int
    """In each of them."""

    def save(self, path: Path) -> None:
        """Into a file."""
        path.write_bytes(pickle.dumps(self))


def building_in(path: Path) -> Building:
    """Out of a file."""
    found: Building = pickle.loads(path.read_bytes())
    return found


def open_robot(port: int, folder: Path, name: str, building: Building, *, link: LinkName = "good") -> Robot:
    """A robot of the team."""
    url = f"http://127.0.0.1:{port}/maps/{MAP}"
    return Robot(None, url, directory=folder / name, name=name, geometry=building.geometry, link=link)


def live(port: int, folder: str, name: str, seed: int, every_s: float, link: LinkName) -> None:
    """Map for ever; what is committed is written down after it is, in the robot's folder.

    Args:
        port: of the robot's link.
        folder: of the team.
        name: of the robot.
        seed: of what it sees when.
        every_s: seconds between two commits, on an average.
        link: its profile.
    """
    logging.disable(logging.CRITICAL)
    random, place = Random(seed), Path(folder)
    building = building_in(place / "building")
    with open_robot(port, place, name, building, link=link) as robot, (place / name / LOG).open("a") as log:
        robot.start_sync(every_s=SYNC_EVERY_S)
        pause = threading.Event()
        while True:
            index = random.randrange(len(building.diffs))
            facts = replace(facts_of(0, building.scans), note=f"{index}")
            commit = robot.replica.commit(building.diffs[index], facts, profile=robot._profile.commits)
            log.write(f"{commit.id}\n")
            log.flush()
            pause.wait(random.expovariate(1 / every_s))
