"""Traffic of a robot that follows another one through a map with epochs: bytes of the replies, without heads of HTTP.

Passes of the small room at 4 cm as in `readings.py`, each in an epoch of its own. One robot follows: it fetches after
every commit. Another one fetches once, at the end. The server runs in this process, on a store in memory.
"""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.bench.pushing import facts_of
from tests.bench.readings import SCANS_A_COMMIT, room_passes
from tests.fixtures.client.made import MAP
from tests.sync_sim.server import FoldOnRequest, SimServer

from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_store import ReplicaStore
from cairn_client.sync.requests import Conversation, GetMissing, NextFrame
from cairn_client.sync.sync import fetch_missing, push_commits
from cairn_map.codec.cell_code import Profile
from cairn_map.commits.ids import RobotName
from cairn_map.epochs.epoch import STANDARD_EPOCH_S, Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.evidence_map import Diff
from cairn_map.evidence.grid import Geometry
from cairn_map.wire.resumed_replies import Replies
from cairn_server import service

Row = tuple[str, str, str]
FOLLOWING_MAX = 1.3
"""Most bytes of a robot that follows, as a multiple of those of the commits."""


def traffic_rows(smoke: bool) -> Iterator[Row]:
    """One line each."""
    layer = MapLayer(geometry=Geometry(), epoch_s=STANDARD_EPOCH_S)
    passes = room_passes(layer.geometry, stops=2 if smoke else 9, yaws=4 if smoke else 12)
    yield f"traffic of {len(passes)} passes of the small room, 4 cm, {sum(map(len, passes))} commits", "", ""
    for profile in Profile:
        yield from _profile_rows(layer, passes, profile)


def _profile_rows(layer: MapLayer, passes: Sequence[Sequence[Diff]], profile: Profile) -> Iterator[Row]:
    commit_bytes, follower_bytes = 0, 0
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setattr(service, "FoldThread", FoldOnRequest)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        server = SimServer(layer)
        stack.callback(server.close)
        ant, bee, fly = (_Robot(name, server, folder, layer) for name in ("ant", "bee", "fly"))
        for robot in (ant, bee, fly):
            stack.callback(robot.replica.close)
        for n, diffs in enumerate(passes):
            for diff in diffs:
                facts = replace(facts_of(n, SCANS_A_COMMIT), epoch=Epoch(n))
                commit_bytes += len(ant.replica.commit(diff, facts, profile=profile).data)
                ant.hold(push_commits(ant.replica))
                server.fold_all()
                follower_bytes += bee.hold(fetch_missing(bee.replica))
        late_bytes = fly.hold(fetch_missing(fly.replica))
        if not ant.replica.view == bee.replica.view == fly.replica.view:
            raise RuntimeError("robots that fetched all hold other maps")
    for text, size_bytes, most in (
        ("follows", follower_bytes, f" (at most {FOLLOWING_MAX:g})"),
        ("fetches all at the end", late_bytes, ""),
    ):
        ratio = f"{size_bytes / commit_bytes:.2f} x the commits' {commit_bytes / 1e6:.2f} MB"
        yield f"  {profile}: a robot that {text}", f"{size_bytes / 1e6:.2f}", f"MB = {ratio}{most}"


class _Robot:
    """A replica that talks to the server in this process."""

    def __init__(self, name: str, server: SimServer, folder: Path, layer: MapLayer) -> None:
        self._name = name
        self._server = server
        self._replies = Replies()
        self.replica = Replica(
            ReplicaStore(folder / name),
            robot=RobotName(name),
            map_name=MAP,
            geometry=layer.geometry,
            epoch_s=layer.epoch_s,
        )

    def hold(self, conversation: Conversation[Any]) -> int:
        """Hold a conversation to its end; bytes of the replies to what is missing."""
        size_bytes, reply, answer = 0, b"", None
        frames: Iterator[Any] = iter(())
        try:
            ask = next(conversation)
            while True:
                if isinstance(ask, GetMissing):
                    asked = self._replies.reply_to(ask.request)
                    reply = self._server.answer(self._name, GetMissing(asked.request))
                    size_bytes += len(reply)
                    frames = iter(asked.frames([reply]) if reply else asked.again())
                is_frame = isinstance(ask, GetMissing | NextFrame)
                answer = next(frames, None) if is_frame else self._server.answer(self._name, ask)
                ask = conversation.send(answer)
        except StopIteration:
            return size_bytes
