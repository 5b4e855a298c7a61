"""Commits that the server refused for what they are: they stay in the outbox, and are not sent again for a while.

Some refusals pass (an admin gives more room, a newer server takes more), and nobody tells a robot so: after an hour, at
the next start, and on another server a commit is tried again.
"""

import time
from collections.abc import Callable

from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, CairnError

REST_S = 3600.0
KINDS_OF_ALL = ("http", "unknown_protocol")
"""Of refusals that tell nothing of the commit: a portal's or proxy's, and one of whatever the robot asks."""


class Resting:
    """What one robot remembers of them, until it ends."""

    def __init__(self, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        self._steady_s = steady_s
        self._refused: dict[CommitId, tuple[CairnError, float]] = {}

    def note(self, commit: CommitId, refusal: CairnError) -> None:
        """The server refused a commit; it rests if that was for its bytes."""
        if isinstance(refusal, BadInputError) and refusal.kind not in KINDS_OF_ALL:
            self._refused[commit] = refusal, self._steady_s() + REST_S

    def refusal(self, commit: CommitId) -> CairnError | None:
        """Why a commit rests; None if it does not."""
        refusal, until_s = self._refused.get(commit, (None, 0.0))
        if refusal is not None and self._steady_s() >= until_s:
            del self._refused[commit]
            return None
        return refusal

    def end(self) -> None:
        """Another server may take them all."""
        self._refused.clear()
