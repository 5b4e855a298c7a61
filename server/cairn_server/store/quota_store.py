"""What the server needs of a database for quotas of a day (`store.Store.uses`)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

Robot = tuple[int, str]
"""Number of the map, and the robot's name, or `relay_of` a token."""


@dataclass(frozen=True, slots=True)
class Use:
    """What a robot's commits took."""

    size_bytes: int = 0
    cells: int = 0

    def __add__(self, more: "Use") -> "Use":
        return Use(self.size_bytes + more.size_bytes, self.cells + more.cells)

    def __sub__(self, less: "Use") -> "Use":
        return Use(self.size_bytes - less.size_bytes, self.cells - less.cells)


def relay_of(token: str) -> str:
    """What stands for a robot's name where a relay's token is meant; no robot has a space in its name."""
    return f"relay {token}"


class Uses(Protocol):
    """What was accepted, as the commits themselves tell: nothing is counted twice or lost with the process."""

    def since(self, time_s: float) -> Mapping[Robot, Use]:
        """What each robot's commits took that came after a time, and what each relay handed over."""
        ...
