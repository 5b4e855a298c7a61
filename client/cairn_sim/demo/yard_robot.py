"""A simulated robot of the demo's yard: goes from stop to stop, and maps into the layers of the place where it is."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from cairn_client.robot.layered_robot import LayeredRobot
from cairn_map.epochs.layer import EVIDENCE
from cairn_map.errors import UnreachableError
from cairn_map.wire.layer_messages import BoxM, MappedLayer
from cairn_sim.robots.record import Plan, places_of, scans_of, shots_of

GROUND = "ground"
"""The layer of the yard: a level."""
SHED: BoxM = ((-15.1, 3.9, -1.3), (-10.9, 7.1, 1.6))
INNER: BoxM = ((-15.1, 3.9, -1.3), (-11.8, 7.1, 1.6))
"""The shed without its doorway, in which a robot maps into both layers, so that the two meet."""
CONTRIBUTES = (MappedLayer(layer=EVIDENCE, inside_m=SHED), MappedLayer(layer=GROUND, outside_m=INNER))
"""The shed of the yard is mapped as evidence, all else as a level."""


@dataclass(slots=True)
class YardProgress:
    """Progress of a robot, for the table."""

    place: str = "waits"
    stops: int = 0
    commits: int = 0
    up_bytes: int = 0
    down_bytes: int = 0


class YardRobot:
    """One robot on its way; `robot` is open until `close`."""

    def __init__(self, name: str, plan: Plan, map_url: str, folder: Path) -> None:
        self.name = name
        self.plan = plan
        self.stop_count = len(places_of(plan))
        self.progress = YardProgress()
        rig = plan.robot.rig_of(plan.scale)
        self._scans = scans_of(plan, shots_of(plan), rig)
        self.robot = LayeredRobot(
            rig,
            map_url,
            directory=folder / name,
            name=name,
            contributes=CONTRIBUTES,
            stay=True,
            times="recorded",  # the scene's time is not this machine's
        )

    def measure(self) -> bool:
        """Take the scans of the next stop, commit, and sync if there is a link; False at the end of the path.

        Raises:
            CairnError: as `LayeredRobot.commit` and `sync`.
        """
        for shot, scan, _ in self._scans:
            x, y, z = scan.T_map_rig[:3, 3].tolist()
            into = self.robot.assignment.layers_at((x, y, z))
            self.progress.place = (
                "in the door" if len(into) > 1 else ("in the shed" if EVIDENCE in into else "outdoors")
            )
            # A commit of its own where an epoch ends amid the scans of a stop.
            self.progress.commits += len(self.robot.observe(scan))
            if shot.ends_stop:
                break
        else:
            self.progress.place = "arrived"
            return False
        self.progress.commits += len(self.robot.commit())
        self.progress.stops += 1
        with suppress(UnreachableError):  # commits wait for the next stop
            self.sync()
        return True

    def sync(self) -> None:
        """One round with the server for each layer, and note what it cost."""
        self.robot.sync()
        traffic = [robot.traffic for robot in self.robot.robots.values()]
        self.progress.up_bytes = sum(each.up_bytes for each in traffic)
        self.progress.down_bytes = sum(each.down_bytes for each in traffic)

    def close(self) -> None:
        """Close the robot's directories."""
        self._scans.close()
        self.robot.close()
