"""A robot of a simulation: a real replica on a disk in memory, and rounds with the server that are under way.

Two at once, which a real robot does not have, so that answers of one come when the other has moved cells; the second
one does not push.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import apsw
from tests.fixtures.client.made import B, random_diff, replica_on

from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.sync.requests import Ask, Conversation
from cairn_client.sync.sync import fetch_cells, fetch_missing, push_commits
from cairn_client.sync.uploads import PARTS, Parts
from cairn_map.commits.commit import split_commit
from cairn_map.commits.ids import CommitId, commit_id_from_text
from cairn_map.commits.mark import Mark
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import CairnError
from cairn_map.evidence.grid import cell_of_key

ROUNDS_AT_ONCE = 2
IN_PARTS = ("r1", "r2")
"""Robots that push in parts."""
HELPINGS: dict[str, dict[str, Any]] = {
    "r1": {"reply_bytes_max": 100, "near": cell_of_key(B)},
    "r4": {"reply_bytes_max": 100, "round_bytes_max": 100},
}
"""Robots that fetch little at a time."""


class MapOfRobots(Protocol):
    """The map, or a layer of one, that robots are on."""

    layer: MapLayer
    name: str


class MemoryDisk(ReplicaStore):
    """A replica's file in memory."""

    def __init__(self, image: bytes = b"") -> None:
        self._folder = Path("in-memory")
        self.file = self._folder / "robot.sqlite"
        self._lock = threading.RLock()
        self._connection = apsw.Connection(":memory:")
        if image:
            self._connection.deserialize("main", image)
        self._prepare()

    def image(self) -> bytes:
        """All bytes of the file."""
        return self._connection.serialize("main")


class SimRobot:
    """One robot; `ask` sends a round's request on its way, and `answered` or `failed` is called some time later."""

    def __init__(
        self, name: str, mode: str, ask: Callable[["SimRobot", int, Ask[Any]], None], *, of: "MapOfRobots"
    ) -> None:
        self.name = name
        self._layer, self._map_name = of.layer, of.name
        self.mode = mode
        self._ask = ask
        self._rounds_begun = 0
        self._conversations: dict[int, Conversation[None]] = {}
        """Those under way, by the number of their round."""
        self._saved: bytes | None = None
        # Commits have some 500 bytes here, most of it meta.
        self._parts = Parts(above_bytes=100, part_bytes=250) if name in IN_PARTS else PARTS
        self._open(MemoryDisk())

    @property
    def is_busy(self) -> bool:
        """Whether a round is under way."""
        return bool(self._conversations)

    def is_in(self, number: int) -> bool:
        """Whether this round is under way: to any other, an answer comes too late."""
        return number in self._conversations

    def commit(
        self,
        seed: int,
        *,
        note: str,
        retracts: tuple[str, ...] = (),
        epoch: Epoch | None = None,
        marks: tuple[Mark, ...] = (),
    ) -> None:
        """Map something, in an epoch; or mark."""
        targets = tuple(map(commit_id_from_text, retracts))
        facts = CommitFacts(retracts=targets, note=note, epoch=epoch, marks=marks)
        self.replica.commit({} if marks else random_diff(seed), facts)

    def check_view(self) -> None:
        """What the view shows is what a robot that starts now on a copy of this disk would show."""
        copy = replica_on(MemoryDisk(self.disk.image()), self.name, map_name=self._map_name, layer=self._layer)
        try:
            assert copy.view == self.replica.view, f"{self.name} shows another map than its disk holds"
        finally:
            copy.close()

    def notes(self) -> dict[CommitId, str]:
        """Commits that are kept here, and their notes."""
        found = {}
        for commit in self.replica.commits:
            data = self.replica.commit_data(commit)
            assert data is not None
            found[commit] = split_commit(data)[0].note
        return found

    def start_round(self) -> None:
        """Begin to sync, unless there is enough under way."""
        if len(self._conversations) < ROUNDS_AT_ONCE:
            self._rounds_begun += 1
            self._conversations[self._rounds_begun] = self._round(pushes=not self.is_busy)
            self.answered(self._rounds_begun, None)

    def answered(self, number: int, answer: Any) -> None:
        """Go on with an answer."""
        conversation = self._conversations[number]
        self._advance(number, lambda: conversation.send(answer))

    def failed(self, number: int, error: CairnError) -> None:
        """Go on with an error of the server or the link."""
        conversation = self._conversations[number]
        self._advance(number, lambda: conversation.throw(error))

    def stop(self) -> None:
        """The program ends without a word."""
        self._conversations.clear()

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

    def _round(self, *, pushes: bool) -> Conversation[None]:
        if pushes:
            report = yield from push_commits(self.replica, sealed_only=self.mode == "viewer", parts=self._parts)
            # A retract of a server that was replaced is not taken by the other one, of which this robot will hear next.
            refused = [commit for commit, exc in report.refused.items() if exc.kind != "not_admitted"]
            assert all(self.replica.seal(commit) is not None for commit in refused)
        if self.mode == "low-end":
            yield from fetch_cells(self.replica)
        else:
            yield from fetch_missing(self.replica, **HELPINGS.get(self.name, {}))

    def _advance(self, number: int, step: Callable[[], Ask[Any]]) -> None:
        try:
            ask = step()
        except (StopIteration, CairnError):
            del self._conversations[number]
        else:
            self._ask(self, number, ask)

    def _open(self, disk: MemoryDisk) -> None:
        self.disk = disk
        self.replica = replica_on(disk, self.name, map_name=self._map_name, layer=self._layer)
