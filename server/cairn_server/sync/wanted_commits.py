"""Commits whose evidence went, and which a retract needs once more, so that whoever has one is asked for it.

It is not written anywhere: after a start a retract is refused once more, and its targets are wanted again.
"""

import threading
from collections.abc import Iterable

from cairn_map.commits.ids import CommitId
from cairn_map.wire.messages import WANTED_MAX


class WantedCommits:
    """Wanted commits of all maps, the newest `WANTED_MAX` of each; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._wanted: dict[str, dict[CommitId, None]] = {}

    def note(self, map_name: str, commits: Iterable[CommitId]) -> None:
        """A retract of these was refused."""
        with self._lock:
            wanted = self._wanted.setdefault(map_name, {})
            wanted.update(dict.fromkeys(commits))
            for commit in list(wanted)[:-WANTED_MAX]:
                del wanted[commit]

    def forget(self, map_name: str, commit: CommitId) -> None:
        """It came."""
        with self._lock:
            self._wanted.get(map_name, {}).pop(commit, None)

    def of(self, map_name: str) -> tuple[CommitId, ...]:
        """Those of a map."""
        with self._lock:
            return tuple(self._wanted.get(map_name, ()))
