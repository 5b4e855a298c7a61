"""A robot of a simulation: a real replica on a disk in memory, and at most one round with the server under way."""

from collections.abc import Callable
from typing import Any

import apsw
from tests.cairn_client.made import GEOMETRY, MAP, random_diff
from tests.sync_sim.server import meta_of

from cairn_client.asks import Ask, Conversation
from cairn_client.outbox import UNNUMBERED
from cairn_client.replica import Replica
from cairn_client.replica_store import ReplicaStore
from cairn_client.sync import fetch_cells, fetch_missing, push_commits
from cairn_map.commit import split_commit
from cairn_map.errors import CairnError
from cairn_map.ids import CommitId, RobotName


class MemoryDisk(ReplicaStore):
    """A replica's file in memory."""

    def __init__(self, image: bytes = b"") -> None:
        self._connection = apsw.Connection(":memory:")
        if image:
            self._connection.deserialize("main", image)
        self._prepare()

    def image(self) -> bytes:
        """All bytes of the file."""
        return self._connection.serialize("main")


class SimRobot:
    """One robot; `ask` sends a request on its way, and `answered` or `failed` is called some time later."""

    def __init__(self, name: str, mode: str, ask: Callable[["SimRobot", Ask[Any]], None]) -> None:
        self.name = name
        self.mode = mode
        self.round = 0
        """Number of the round under way, or of the last one: an answer to an older one comes too late."""
        self._ask = ask
        self._conversation: Conversation[None] | None = None
        self._saved: bytes | None = None
        self._open(MemoryDisk())

    @property
    def is_busy(self) -> bool:
        """Whether a round is under way."""
        return self._conversation is not None

    def commit(self, seed: int, *, note: str, retracts: tuple[str, ...] = ()) -> None:
        """Map something."""
        unnumbered = CommitId(self.replica.author, UNNUMBERED)
        self.replica.commit(random_diff(seed), meta_of(unnumbered, note=note, retracts=retracts))

    def notes(self) -> dict[CommitId, str]:
        """Commits that are kept here, and their notes."""
        found = {}
        for commit in self.replica.commits:
            data = self.replica.commit_data(commit)
            assert data is not None
            found[commit] = split_commit(data)[0].note
        return found

    def start_round(self) -> None:
        """Begin to sync, unless it does already."""
        if not self.is_busy:
            self.round += 1
            self._conversation = self._rounds()
            self.answered(None)

    def answered(self, answer: Any) -> None:
        """Go on with an answer."""
        conversation = self._conversation
        assert conversation is not None
        self._advance(lambda: conversation.send(answer))

    def failed(self, error: CairnError) -> None:
        """Go on with an error of the server or the link."""
        conversation = self._conversation
        assert conversation is not None
        self._advance(lambda: conversation.throw(error))

    def stop(self) -> None:
        """The program ends without a word."""
        self.round += 1
        self._conversation = None

    def restart(self) -> None:
        """It starts again."""
        self.stop()
        self._open(self.disk)

    def save_disk(self) -> None:
        """Somebody copies the disk."""
        self._saved = self.disk.image()

    def roll_back_disk(self) -> None:
        """Somebody puts that copy back."""
        if self._saved is not None:
            self.stop()
            self.replica.close()
            self._open(MemoryDisk(self._saved))

    def lose_disk(self) -> None:
        """The disk is gone."""
        self.stop()
        self.replica.close()
        self._open(MemoryDisk())

    def _rounds(self) -> Conversation[None]:
        report = yield from push_commits(self.replica, sealed_only=self.mode == "viewer")
        # A retract of a server that was replaced is not taken by the other one, of which this robot will hear next.
        assert all(self.replica.seal(commit) is not None for commit in report.refused)
        if self.mode == "low-end":
            yield from fetch_cells(self.replica)
        else:
            yield from fetch_missing(self.replica)

    def _advance(self, step: Callable[[], Ask[Any]]) -> None:
        try:
            ask = step()
        except (StopIteration, CairnError):
            self._conversation = None
        else:
            self._ask(self, ask)

    def _open(self, disk: MemoryDisk) -> None:
        self.disk = disk
        self.replica = Replica(disk, robot=RobotName(self.name), map_name=MAP, geometry=GEOMETRY)
