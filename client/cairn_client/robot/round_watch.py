"""Outcome of a robot's rounds with its server: sent to the robot's event streams, and remembered in its folder.

The last contact and the failures since then are written at most every ten seconds: a robot may sync often, and each
write costs the flash a page.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import Contact
from cairn_client.robot.robot_events import CellsChanged, Events, LinkBack, LinkLost, Pushed, Refused, SyncFailed
from cairn_client.sync.sync import RoundReport
from cairn_map.commits.ids import CommitId
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.evidence.grid import cell_of_key

log = logging.getLogger(__name__)

REMEMBER_EVERY_S = 10.0
"""Least seconds between two writes of the last contact, while all goes well."""


class RoundWatch:
    """Watch over every round of one robot."""

    def __init__(self, replica: Replica, events: Events) -> None:
        self._replica = replica
        self._events = events
        self._refused: dict[CommitId, str] = {}
        """Kinds of the refusals that were reported: each once, however often the commit is pushed."""
        self._tries = 0
        self._contact = replica.state.contact or Contact()
        self._remembered_s = float("-inf")

    @contextmanager
    def cell_changes(self) -> Iterator[None]:
        """Context of a round; after it, the cells that it changed are reported, also where the round failed."""
        self._replica.take_changes()
        try:
            yield
        finally:
            if changed := self._replica.take_changes():
                self._events.send(CellsChanged(cells=tuple(cell_of_key(key) for key in changed)))

    def succeeded(self, report: RoundReport) -> None:
        """Report that a round was completed: its refusals, the link if it was away, the time of the contact."""
        for commit, exc in report.refused.items():
            if self._refused.get(commit) != exc.kind:
                self._refused[commit] = exc.kind
                self._events.send(Refused(commit=commit, kind=exc.kind, reason=exc.message))
        now_s = time.time()
        if self._tries:
            self._events.send(LinkBack(away_s=max(0.0, now_s - (self._contact.failed_s or now_s))))
        # A robot that the server knows by another key fetches, and goes on failing to push until an operator says so.
        shut_out = next((exc for exc in report.refused.values() if exc.kind == "not_admitted"), None)
        contact = Contact(last_s=now_s)
        if shut_out is not None:
            since_s = self._contact.failed_s or now_s
            contact = Contact(last_s=now_s, failed_s=since_s, kind=shut_out.kind, reason=shut_out.message[:1000])
        self._remember(contact, at_once=self._tries > 0 or contact.kind != self._contact.kind)
        self._tries = 0

    def pushed(self, commit: CommitId) -> None:
        """Report that the server acknowledged a commit."""
        self._refused.pop(commit, None)
        self._events.send(Pushed(commit=commit))

    def failed(self, exc: CairnError, again_s: float | None) -> None:
        """Report that a round failed, and is tried again in so many seconds; None: unknown."""
        self._tries += 1
        kind = LinkLost if isinstance(exc, UnreachableError) else SyncFailed
        self._events.send(kind(kind=exc.kind, reason=exc.message, tries=self._tries, again_s=again_s))
        now_s = time.time()
        since_s = self._contact.failed_s or now_s
        update = {"failed_s": since_s, "kind": exc.kind, "reason": exc.message[:1000]}
        self._remember(self._contact.model_copy(update=update), at_once=self._tries == 1)

    def _remember(self, contact: Contact, *, at_once: bool) -> None:
        self._contact = contact
        if not at_once and time.monotonic() - self._remembered_s < REMEMBER_EVERY_S:
            return
        self._remembered_s = time.monotonic()
        try:
            self._replica.state.contact = contact
        except CairnError as exc:  # the disk is full or broken: that is no failure of the round
            log.warning("the last contact cannot be remembered: %s", exc.message)
