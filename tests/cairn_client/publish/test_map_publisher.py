"""Publisher of a followed map: what a robot says, a storey that grows, a link that breaks."""

import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.fixtures.client.floors import push_storey
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, A
from tests.fixtures.client.robots import push_diffs
from tests.fixtures.fusion.cdr_reader import read_message
from tests.naive.evidence import interleave

from cairn_client.cli.maps.command import main
from cairn_client.http.api import MapApi
from cairn_client.publish.followed_map import FollowedMap
from cairn_client.publish.map_publisher import PATH_S, POSES_MAX, STEP_M, FloorChoice, MapPublisher, path_topic
from cairn_fusion.ros.map_messages import MapMessage, definition_of
from cairn_map.commits.commit import ScanPose
from cairn_map.commits.ids import NAME
from cairn_map.errors import NotFoundError, UnreachableError
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.grid import CellKey, cell_key
from cairn_map.wire.live_events import CellsEvent
from cairn_map.wire.mark_messages import MarkRequest, MarkText
from cairn_map.wire.messages import RobotStatus

BAND = (0.05, 0.25)
ABOVE = cell_key((0, 0, 1))
FAR = cell_key((0, 0, 9))
PATH = "/cairn/robots/mole/path"


class Shelf:
    """A sink that keeps all messages."""

    def __init__(self) -> None:
        self.messages: list[MapMessage] = []

    def send(self, message: MapMessage) -> None:
        self.messages.append(message)

    def of(self, topic: str) -> list[dict[str, Any]]:
        """Messages of a topic, oldest first."""
        return [
            read_message(definition_of(message.type_name), message.type_name, message.data)
            for message in self.messages
            if message.topic == topic
        ]


class Clock:
    """A clock that stands until it is moved."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Published:
    """A map of a server, published onto a shelf."""

    def __init__(self, server: LiveServer) -> None:
        self.api, self.shelf, self.clock = MapApi(server.url), Shelf(), Clock()
        self.followed = FollowedMap(self.api, MAP)
        choice = FloorChoice(ground_m=None, band_m=BAND, frame="map")
        self.publisher = MapPublisher(self.api, self.followed, [self.shelf], choice, steady_s=self.clock)

    def publish(self) -> int:
        """Publish what changed; number of cells."""
        self.followed.note_any()
        return self.publisher.publish_changes(self.followed.fetch())

    def hear(self, time_s: float, x_m: float) -> None:
        """A robot says where it is."""
        pose = ScanPose(time_s=time_s, t_map_rig=(x_m, 0.0, 0.0), q_map_rig=(0.0, 0.0, 0.0, 1.0))
        self.publisher.publish_robot("mole", RobotStatus(time_s=1.7e9, pose=pose))


@pytest.fixture
def published(server: LiveServer, tmp_path: Path) -> Iterator[Published]:
    push_storey(server, tmp_path / "mole")
    found = Published(server)
    with found.api:
        yield found


@pytest.mark.parametrize("time_s", [-1.0, 2.0**31 - 0.5, 2.0**31, 1e300])
def test_a_pose_at_a_time_that_ros_has_not_is_left_out(published: Published, time_s: float) -> None:
    published.hear(time_s, 1.0)
    assert not published.shelf.messages
    published.hear(2.0**31 - 1, 1.0)
    assert [message.topic for message in published.shelf.messages] == ["/tf", PATH]


def test_evidence_taken_out_while_the_link_was_broken_is_gone(
    published: Published, server: LiveServer, tmp_path: Path
) -> None:
    followed = published.followed
    followed.fetch()
    before = followed.snapshot.voxels_in().counts
    push_storey(server, tmp_path / "wren", wall_x=2)
    followed.note(CellsEvent(id="", cells=[(0, 0, 0, 2)]))
    assert followed.fetch() == [A]
    assert not np.array_equal(followed.snapshot.voxels_in().counts, before)
    wall = published.api.log(MAP)[1].id
    assert main(["retract", server.map_url, "--commit", wall]) == 0
    server.wait_for_fold()
    followed.note_any()
    assert followed.fetch() == [A]
    np.testing.assert_array_equal(followed.snapshot.voxels_in().counts, before)


def columns(*, ground: int, side: int) -> Evidence:
    """A surface with air on it, over the first `side` x `side` columns."""
    rows = [
        (interleave(x, y, z), int(z == ground), int(z != ground))
        for x in range(side)
        for y in range(side)
        for z in range(ground, GEOMETRY.side)
    ]
    table = np.array(sorted(rows), np.int64)
    return packed_evidence(table[:, 0].astype(np.uint32), table[:, 1:], np.zeros((len(table), 3), np.int64), GEOMETRY)


def test_a_storey_twice_as_large_is_published_in_the_place_of_the_first(server: LiveServer, tmp_path: Path) -> None:
    """A table top is seen down to first; then a floor; then another storey's, which is a bit larger alone."""
    found = Published(server)

    def ground_after(diff: dict[CellKey, Evidence]) -> float | None:
        push_diffs(server, tmp_path / "mole", diff)
        found.publish()
        return found.publisher.ground_m

    with found.api:
        assert ground_after({A: columns(ground=2, side=3)}) == pytest.approx(0.15)
        assert ground_after({ABOVE: columns(ground=0, side=7)}) == pytest.approx(0.45)
        assert ground_after({A: columns(ground=2, side=8)}) == pytest.approx(0.45)
    assert [grid["info"]["origin"]["position"]["z"] for grid in found.shelf.of("/map")] == pytest.approx(
        [0.15, 0.45, 0.45]
    )


def test_a_change_that_a_broken_link_kept_back_is_published_later(published: Published) -> None:
    changed = published.followed.fetch()
    published.api.sockets.cut()
    with pytest.raises(UnreachableError):
        published.publisher.publish_changes(changed)
    assert published.publisher.is_behind
    published.api.sockets.mend()
    assert published.publisher.publish_changes([]) == 1
    assert not published.publisher.is_behind
    *_, last = published.shelf.of("/cairn/changed_points")
    assert last["width"] == GEOMETRY.side**2
    assert published.shelf.of("/cairn/hot_spots")


def test_cells_that_came_before_a_failure_are_returned_later(
    published: Published, server: LiveServer, tmp_path: Path
) -> None:
    published.followed.note(CellsEvent(id="", cells=[(0, 0, 0, 1), (0, 0, 9, 1)]))
    with pytest.raises(NotFoundError):
        published.followed.fetch()
    push_diffs(server, tmp_path / "mole", {FAR: columns(ground=0, side=2)})
    assert published.followed.fetch() == [A, FAR]


def test_a_path_has_a_pose_a_step_and_is_sent_once_in_a_while(published: Published) -> None:
    count = 60
    for n in range(count):
        published.hear(n, n * 0.01)
    assert len(published.shelf.of("/tf")) == count
    assert len(published.shelf.of(PATH)) == 1
    published.clock.now_s = PATH_S
    published.publisher.publish_due()
    published.publisher.publish_due()
    _, path = published.shelf.of(PATH)
    places = [pose["pose"]["position"]["x"] for pose in path["poses"]]
    assert (places[0], places[-1]) == (0.0, 0.59)
    assert min(np.diff(places)[:-1]) >= STEP_M


def test_a_long_path_keeps_its_begin_and_a_bounded_number_of_poses(published: Published) -> None:
    count = 2 * POSES_MAX
    for n in range(count):
        published.hear(n, 0.06 * n)
    published.clock.now_s = PATH_S
    published.publisher.publish_due()
    *_, path = published.shelf.of(PATH)
    places = [pose["pose"]["position"]["x"] for pose in path["poses"]]
    assert POSES_MAX / 2 <= len(places) <= POSES_MAX + 1
    assert (places[0], places[-1]) == (0.0, 0.06 * (count - 1))


@pytest.mark.parametrize(
    ("robot", "name"), [("mole", "mole"), ("mole-2", "mole_2"), ("mole_2", "mole_U2"), ("2nd", "_2nd")]
)
def test_topics_of_robots_are_names_that_ros_takes(robot: str, name: str) -> None:
    assert path_topic(robot) == f"/cairn/robots/{name}/path"


def test_no_two_robots_share_a_topic() -> None:
    names = ["".join(letters) for count in range(1, 5) for letters in product("a2-_u", repeat=count)]
    topics = [path_topic(name) for name in names if NAME.fullmatch(name)]
    assert len(set(topics)) == len(topics)
    assert all(re.fullmatch(r"/cairn/robots/[A-Za-z_][A-Za-z0-9_]*/path", topic) for topic in topics)


def test_marks_are_published_as_they_come_and_go(published: Published) -> None:
    api, publisher = published.api, published.publisher
    publisher.publish_marks()
    assert published.shelf.of("/cairn/marks") == []
    door = MarkText(kind="door", name="north door", place_m=(1.0, 2.0, 0.5), extent_m=(1.0, 0.1, 2.0))
    key = api.put_mark(MAP, MarkRequest(mark=door)).key
    publisher.publish_marks()
    publisher.publish_marks()
    assert key is not None
    api.put_mark(MAP, MarkRequest(of=key))
    publisher.publish_marks()
    texts = [[marker["text"] for marker in found["markers"]] for found in published.shelf.of("/cairn/marks")]
    assert texts == [["", "", "north door (door)"], [""]]
