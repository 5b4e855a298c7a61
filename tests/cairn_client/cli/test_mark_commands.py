"""Marks on the command line: added, listed, changed, removed, watched, and refused with the next step."""

import hashlib
import json
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import MAP
from tests.fixtures.client.robots import robot_in
from tests.fixtures.commands import cairn

from cairn_client.cli.maps.watch import lines_of
from cairn_map.commits.attachment import attachment_of
from cairn_map.wire.live_events import MarksEvent
from cairn_map.wire.mark_messages import MarkPage


def mark(server: LiveServer, folder: Path, *arguments: str, code: int = 0) -> str:
    """Run `cairn map mark`, and wait until its commit is in the map."""
    said = cairn("map", "mark", server.map_url, *arguments, folder=folder, code=code)
    server.wait_for_fold()
    return said


def listed(server: LiveServer, folder: Path, *arguments: str) -> MarkPage:
    text = cairn("map", "marks", server.map_url, "--json", *arguments, folder=folder)
    return MarkPage.model_validate_json(text)


def test_a_mark_is_added_listed_changed_and_removed(server: LiveServer, tmp_path: Path) -> None:
    assert "no marks" in cairn("map", "marks", server.map_url, folder=tmp_path)
    said = mark(server, tmp_path, "--add", "north door", "--at", "1.5,-2,1", "--kind", "door", "--note", "locked\nnow")
    key = said.split()[0]
    assert said == f"{key}  door  north door  at 1.50, -2.00, 1.00 m\n"
    mark(server, tmp_path, "--add", "lamp", "--at", "0,0,2")

    lines = cairn("map", "marks", server.map_url, folder=tmp_path).splitlines()
    assert lines[0].startswith(f"{key}  door  north door  at 1.50, -2.00, 1.00 m  by local, 20")
    assert (lines[1:3], lines[3].split()[1:3]) == (["  locked", "  now"], ["mark", "lamp"])
    first = listed(server, tmp_path)
    assert lines[-1] == f"state {first.cursor}"
    box, kind = ("--box", "1,-3,0,2,-1,2"), ("--kind", "door")
    for choice in (box, kind):
        assert [entry.key for entry in listed(server, tmp_path, *choice).marks] == [key]

    changed = json.loads(mark(server, tmp_path, "--edit", key, "--note", "open", "--extent", "0.9,0.1,2", "--json"))
    (entry,) = listed(server, tmp_path, *kind).marks
    assert (entry.key, entry.mark.name, entry.mark.note, entry.mark.extent_mm) == (
        *(changed["key"], "north door", "open", (900, 100, 2000)),
    )
    news = listed(server, tmp_path, "--after", first.cursor)
    assert ([entry.key for entry in news.marks], news.removed) == ([changed["key"]], [key.partition(":")[0]])

    assert mark(server, tmp_path, "--remove", changed["key"]) == f"{changed['key']} is removed\n"
    assert [entry.mark.name for entry in listed(server, tmp_path).marks] == ["lamp"]


def test_marks_of_robots_are_listed_and_those_that_were_changed_twice_are_named(
    server: LiveServer, tmp_path: Path
) -> None:
    with robot_in(tmp_path, server.map_url) as robot:
        first = robot.mark("lamp", (0, 0, 1))
        robot.sync(until_folded=True)
        mark(server, tmp_path, "--edit", str(first.id), "--name", "lamp of the hall")
        robot.mark("lamp, off", (0, 0, 1), instead_of=first)
        robot.sync(until_folded=True)
    lines = cairn("map", "marks", server.map_url, folder=tmp_path).splitlines()
    assert [line.endswith("(changed twice: remove one)") for line in lines] == [True, True, False]


def test_marks_are_listed_as_groups_of_one_kind(server: LiveServer, tmp_path: Path) -> None:
    for name, at, kind in (("drip", "1,1,0", "leak"), ("leak", "1.2,1,0", "leak"), ("lamp", "1,1,0", "lamp")):
        mark(server, tmp_path, "--add", name, "--at", at, "--kind", kind)
    lines = cairn("map", "marks", server.map_url, "--group", "0.5", folder=tmp_path).splitlines()
    assert [line.partition("  by local, ")[0] for line in lines] == [
        "2 marks  leak  leak  at 1.10, 1.00, 0.00 m",
        "1 marks  lamp  lamp  at 1.00, 1.00, 0.00 m",
    ]
    groups = json.loads(cairn("map", "marks", server.map_url, "--group", "0.1", "--json", folder=tmp_path))
    assert [(group["name"], len(group["keys"]), group["authors"]) for group in groups] == [
        ("drip", 1, ["local"]),
        ("leak", 1, ["local"]),
        ("lamp", 1, ["local"]),
    ]
    assert "no marks" in cairn("map", "marks", server.map_url, "--group", "1", "--kind", "door", folder=tmp_path)
    cairn("map", "marks", server.map_url, "--group", "-1", folder=tmp_path, code=1)


def test_a_file_is_attached_saved_and_taken_off(server: LiveServer, tmp_path: Path) -> None:
    picture = b"\x89PNG\r\n\x1a\n" + b"p" * 70_000
    (tmp_path / "lock.png").write_bytes(picture)
    at = ("--at", "1.5,-2,1")
    key = mark(server, tmp_path, "--add", "north door", *at, "--attach", "lock.png").split()[0]
    sha = hashlib.sha256(picture).hexdigest()
    assert f"  attachment {sha}, 70.0 kB" in cairn("map", "marks", server.map_url, folder=tmp_path)
    said = cairn("map", "marks", server.map_url, "--save-attachments", "saved", folder=tmp_path)
    assert f"saved saved/{sha}.png" in said.splitlines()
    assert (tmp_path / "saved" / f"{sha}.png").read_bytes() == picture
    # An edit of another field keeps it; one says so where it did not come to the server.
    changed = json.loads(mark(server, tmp_path, "--edit", key, "--note", "open", "--json"))
    (entry,) = listed(server, tmp_path).marks
    assert entry.mark.attachment == attachment_of(picture)
    row = server.service.store.map(MAP)
    server.service.store.attachments.drop(row.number, bytes.fromhex(sha))
    said = cairn("map", "marks", server.map_url, "--save-attachments", "saved", folder=tmp_path)
    assert "did not come to the server yet" in said
    mark(server, tmp_path, "--edit", changed["key"], "--detach")
    assert [each.mark.attachment for each in listed(server, tmp_path).marks] == [None]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("--add", "door"), 1, "--at X,Y,Z"),
        (("--edit", "mole.0123456789abcdef.0"), 1, "what is to change"),
        (("--edit", "mole.0123456789abcdef.0", "--note", "x"), 3, "no mark"),
        (("--remove", "mole.0123456789abcdef.0:1"), 3, "no mark"),
        (("--remove", "mole.0123456789abcdef.0:1", "--note", "x"), 1, "a key alone"),
        (("--add", "door", "--at", "0,0,0", "--attach", "none.jpg"), 1, "cannot read none.jpg"),
        (("--add", "door", "--at", "0,0,0", "--detach"), 1, "--edit"),
        (("--remove", "mole.0123456789abcdef.0:1", "--attach", "/dev/null"), 1, "one byte or more"),
        (("--remove", "door"), 1, "robot.incarnation.n:number"),
        (("--add", "x" * 65, "--at", "0,0,0"), 1, "name"),
        (("--add", "door", "--at", "0,0,1e9"), 1, "within"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_the_next_step(
    server: LiveServer, tmp_path: Path, arguments: tuple[str, ...], code: int, said: str
) -> None:
    assert said in mark(server, tmp_path, *arguments, code=code)
    assert listed(server, tmp_path).marks == []


def test_a_watcher_reads_of_marks(server: LiveServer, tmp_path: Path) -> None:
    mark(server, tmp_path, "--add", "north\u2028door", "--at", "1,2,3", code=1)
    mark(server, tmp_path, "--add", "north door", "--at", "1,2,3")
    (entry,) = listed(server, tmp_path).marks
    event = MarksEvent(id="1.00000000.0", marks=[entry], removed=["mole.0123456789abcdef.0"])
    assert list(lines_of(event)) == [
        f"mark  {entry.key}  mark  north door  at (1.00, 2.00, 3.00) m  by local",
        "mark  mole.0123456789abcdef.0  was changed or removed",
    ]
    (many,) = lines_of(MarksEvent(id="1.00000000.0", marks="many"))
    assert "cairn map marks" in many
