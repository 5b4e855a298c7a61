"""A robot that carries for others: at each server it hands over what it has with it, and takes along what it lacks."""

from pathlib import Path

from cairn_client.relay.carried import CarriedCommits
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.log import tell
from cairn_client.relay.round import RelayReport, Resting, relay_round

FOLDER = "carried"


class Carrier:
    """What a robot carries in its directory, beside its own state."""

    def __init__(self, directory: Path, api: RelayApi, map_name: str, *, size_bytes_max: int) -> None:
        self._here = CarriedCommits(directory / FOLDER, map_name, size_bytes_max=size_bytes_max)
        self._there = ServerEnd(api, map_name)
        self._map_name = map_name
        self._resting = Resting()

    def exchange(self) -> RelayReport:
        """One round with the server that the robot is at.

        Raises:
            UnreachableError: the link broke; what was handed over stays so.
        """
        report = hold_between(relay_round(self._resting), self._here, self._there)
        tell(report, self._map_name, there="the server")
        if report.cut:
            raise report.cut
        return report


def carrier_in(directory: Path, api: RelayApi, map_name: str, *, size_bytes_max: int) -> Carrier | None:
    """Of a robot with so much room for others' commits; None if it has none."""
    return Carrier(directory, api, map_name, size_bytes_max=size_bytes_max) if size_bytes_max else None
