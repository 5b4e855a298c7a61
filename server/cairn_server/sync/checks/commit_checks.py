"""Where a commit is checked: a quick one beside the event loop, an ordinary one in the thread that brought it, and a
dear one in a worker process.

What is ordinary is known beforehand, from the heads (`commit_cost`), and bounded: so no commit keeps the server's own
process busy for longer than a blink, or makes it grow.
"""

import logging
import threading

from cairn_map.commits.commit_reading import CommitReader
from cairn_server.settings import Settings
from cairn_server.sync.checks.check_pool import CheckPool
from cairn_server.sync.checks.check_process import CheckProcess, LostCheckError
from cairn_server.sync.checks.checking import Checked, check_commit
from cairn_server.sync.checks.commit_cost import check_cost, cost_of

log = logging.getLogger(__name__)

ORDINARY_S = 0.05
"""Commits that may cost no more are checked in threads."""
THREADS_MAX = 4
"""Of them at once."""
QUICK_S = 0.01
"""Commits that may cost no more, as nearly all of one scan do, need no thread: one costs more than they do."""


class CommitChecks:
    """Checks commits; called from many threads."""

    def __init__(self, settings: Settings, process: CheckProcess | None = None) -> None:
        self.ordinary_s = ORDINARY_S
        self._process = process
        self._threads = threading.BoundedSemaphore(THREADS_MAX)
        self._pool = CheckPool(
            workers=settings.check_workers, limit_s=settings.check_cpu_s, memory_bytes=settings.check_memory_bytes
        )

    def check(self, commit: CommitReader) -> Checked:
        """What a whole commit holds.

        Raises:
            BadInputError: kind `too_costly`; or as `check_commit`.
            DamagedDataError: as `check_commit`.
            UnreachableError: kind `busy`, `check_failed` or `shutting_down`: later.
        """
        cost = cost_of(commit.readers)
        check_cost(cost, size_bytes=len(commit.data))
        if cost.seconds > self.ordinary_s:
            return self._pool.check(commit.data)
        if cost.seconds <= QUICK_S:
            return check_commit(commit)
        with self._threads:
            return check_commit(commit)

    async def check_soon(self, commit: CommitReader) -> Checked:
        """`check` for a quick commit, while the event loop does other things.

        Raises:
            BadInputError, DamagedDataError: as `check`.
        """
        if self._process is not None:
            check_cost(cost_of(commit.readers), size_bytes=len(commit.data))
            try:
                return await self._process.check(commit.data)
            except LostCheckError:
                self._give_up_process()  # if it is gone
        return self.check(commit)

    def is_quick(self, commit: CommitReader) -> bool:
        """Whether `check` will be done in a moment, and wait for nobody."""
        return cost_of(commit.readers).seconds <= min(QUICK_S, self.ordinary_s)

    def close(self) -> None:
        """End the workers."""
        self._pool.close()
        if self._process is not None:
            self._process.close()

    def _give_up_process(self) -> None:
        process = self._process
        if process is not None and process.is_lost:  # the first of those that waited for it
            self._process = None
            log.error("the process that checks small commits was killed; checking in the server's own from now on")
            process.close()
