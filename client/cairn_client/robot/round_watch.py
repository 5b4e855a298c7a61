"""What came of a robot's rounds with its server: told as events, and remembered for who looks at its folder.

The last contact and the failures since then are written at most every ten seconds: a robot may sync often, and each
write costs the flash a page.
"""

import logging
import time
from collections.abc import Callable

from pydantic import BaseModel, ConfigDict

from cairn_client.replica.replica import Replica
from cairn_client.robot.robot_events import CellsChanged, Events, LinkBack, LinkLost, Pushed, Refused, SyncFailed
from cairn_client.sync.sync import RoundReport
from cairn_map.commits.ids import CommitId
from cairn_map.errors import CairnError, UnreachableError
from cairn_map.evidence.grid import CellKey, cell_of_key

log = logging.getLogger(__name__)

REMEMBER_EVERY_S = 10.0
CONTACT_KEY = "contact"


class Contact(BaseModel):
    """When the server was last spoken to, and what is wrong since then."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    last_s: float | None = None
    """End of the last whole round, UTC; None: there was none yet."""
    failed_s: float | None = None
    """First failure since then."""
    kind: str = ""
    """Of the last failure since then; empty if there was none."""
    reason: str = ""


class RoundWatch:
    """Sees every round of one robot."""

    def __init__(self, replica: Replica, events: Events) -> None:
        self._replica = replica
        self._events = events
        self._refused: dict[CommitId, str] = {}
        """With the kind: a refusal is told once, however often the commit is pushed."""
        self._tries = 0
        remembered = replica.store.get(CONTACT_KEY)
        self._contact = Contact.model_validate_json(remembered) if remembered else Contact()
        self._remembered_s = float("-inf")

    def round(self, action: Callable[[], RoundReport]) -> RoundReport:
        """Do a round and tell what it changed; its failure is told by who knows when it is tried again (`failed`)."""
        before = self._fingerprints()
        try:
            report = action()
        finally:
            after = self._fingerprints()
            changed = sorted(key for key in after.keys() | before.keys() if after.get(key) != before.get(key))
            if changed:
                self._events.tell(CellsChanged(cells=tuple(cell_of_key(key) for key in changed)))
        for commit, exc in report.refused.items():
            if self._refused.get(commit) != exc.kind:
                self._refused[commit] = exc.kind
                self._events.tell(Refused(commit=commit, kind=exc.kind, reason=exc.message))
        self._worked()
        return report

    def pushed(self, commit: CommitId) -> None:
        """The server acknowledged a commit."""
        self._refused.pop(commit, None)
        self._events.tell(Pushed(commit=commit))

    def failed(self, exc: CairnError, *, again_s: float | None = None) -> None:
        """A round failed, and will be tried again in so many seconds, if anybody knows."""
        self._tries += 1
        told = LinkLost if isinstance(exc, UnreachableError) else SyncFailed
        self._events.tell(told(kind=exc.kind, reason=exc.message, tries=self._tries, again_s=again_s))
        now_s = time.time()
        since_s = self._contact.failed_s or now_s
        update = {"failed_s": since_s, "kind": exc.kind, "reason": exc.message[:1000]}
        self._remember(self._contact.model_copy(update=update), at_once=self._tries == 1)

    def _worked(self) -> None:
        now_s = time.time()
        if self._tries:
            self._events.tell(LinkBack(away_s=max(0.0, now_s - (self._contact.failed_s or now_s))))
        self._remember(Contact(last_s=now_s), at_once=self._tries > 0)
        self._tries = 0

    def _remember(self, contact: Contact, *, at_once: bool) -> None:
        self._contact = contact
        if not at_once and time.monotonic() - self._remembered_s < REMEMBER_EVERY_S:
            return
        self._remembered_s = time.monotonic()
        try:
            with self._replica.lock, self._replica.store.transaction():
                self._replica.store.put(CONTACT_KEY, contact.model_dump_json())
        except CairnError as exc:  # the disk is full or broken: that is no failure of the round
            log.warning("the last contact cannot be remembered: %s", exc.message)

    def _fingerprints(self) -> dict[CellKey, object]:
        with self._replica.lock:
            return {key: cell.fingerprint for key, cell in self._replica.cells.items()}
