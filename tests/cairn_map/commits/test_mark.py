"""Marks: records, commits with marks, version 3, and the set that they make."""

import json
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import LAYER, epoch_commit
from tests.fixtures.map.made import MIDDLE, ROBOT, SMALL, made_commit, random_evidence
from tests.fixtures.map.marks import mark, mark_commit
from tests.naive import wire as naive_wire

from cairn_map.commits.attachment import ATTACHMENT_BYTES_MAX, attachment_of
from cairn_map.commits.commit import (
    EPOCH_VERSION,
    MARK_VERSION,
    SUM_VERSION,
    CommitMeta,
    commit_bytes,
    living_marks,
    make_commit,
    renamed_commit,
    sha_without_evidence,
    split_commit,
    version_of_meta,
)
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.commits.mark import (
    AMENDED_MAX,
    MARKS_MAX,
    MILLIMETRES_MAX,
    Mark,
    MarkKey,
    check_place,
    mark_key_from_text,
)
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.grid import cell_key

WREN = "wren.00112233445566aa"
IDS = [f"{WREN}.{n}" for n in range(AMENDED_MAX)]
lengths = st.integers(-MILLIMETRES_MAX, MILLIMETRES_MAX)
texts = st.text(st.characters(exclude_categories=("C", "Zl", "Zp")), min_size=1, max_size=20)
marks = st.builds(
    Mark,
    kind=st.from_regex(r"\A[a-z][a-z0-9_]{0,31}\Z"),
    name=texts.filter(str.strip),
    place_mm=st.tuples(lengths, lengths, lengths),
    extent_mm=st.tuples(*[st.integers(0, MILLIMETRES_MAX)] * 3),
    note=texts,
    time_ms=st.integers(-(10**14), 10**14),
    by=texts.filter(str.strip),
    attachment=st.none() | st.builds(attachment_of, st.binary(min_size=1, max_size=20)),
)


MADE = mark_commit(0, mark(), mark("door", kind="door", extent_m=(0.9, 0.1, 2.0), note="locked\nfrom inside"))


def refusal(data: bytes) -> str:
    with pytest.raises(CairnError) as refused:
        open_commit(data)
    return refused.value.kind


def with_meta(version: int = MARK_VERSION, **changes: object) -> bytes:
    """Bytes of a commit whose meta is changed, whatever it then says."""
    fields = json.loads(MADE.text) | changes
    text = json.dumps({name: value for name, value in fields.items() if value is not None}).encode()
    return commit_bytes(text, {}, version=version)


def with_mark(**changes: object) -> bytes:
    """Bytes of a commit of which the first mark is changed."""
    first, second = json.loads(MADE.text)["marks"]
    return with_meta(marks=[first | changes, second])


@given(st.lists(marks, min_size=1, max_size=4))
def test_opening_undoes_making(found: list[Mark]) -> None:
    made = mark_commit(3, *found)
    assert open_commit(made.data) == (made, {})
    assert split_commit(made.data) == (made.meta, {})
    assert made.meta.marks == tuple(found)
    assert (made.meta.version, version_of_meta(made.text)) == (MARK_VERSION, MARK_VERSION)
    assert Mark.model_validate_json(found[0].to_json()) == found[0]


def test_the_sha_is_what_its_twin_says() -> None:
    assert naive_wire.commit_parts(MADE.data) == (MADE.text, [], MADE.sha)
    assert sha_without_evidence(MADE.data) == MADE.sha


def test_a_renamed_commit_keeps_its_marks() -> None:
    renamed = renamed_commit(MADE.data, commit=commit_id_from_text(f"{ROBOT}.9"), parent=None)
    assert (open_commit(renamed.data)[0], renamed.meta.marks) == (renamed, MADE.meta.marks)


def test_commits_without_marks_keep_their_bytes_and_their_version() -> None:
    for commit, version in ((made_commit(note="marks of the lift"), SUM_VERSION), (epoch_commit(), EPOCH_VERSION)):
        assert (commit.data[4], commit.meta.version, version_of_meta(commit.text)) == (version, version, version)
        assert b'"marks":' not in commit.text
    # Fields that equal their default may be there: such a meta is of the version that it had without them.
    stated = json.dumps(json.loads(made_commit().text) | {"marks": [], "layers": []}).encode()
    assert version_of_meta(stated) == SUM_VERSION
    assert split_commit(commit_bytes(stated, made_commit().cells))[0].version == SUM_VERSION


def test_a_commit_with_marks_is_of_any_map_of_its_grid() -> None:
    assert make_commit(MADE.meta, {}, LAYER) == MADE
    with pytest.raises(BadInputError, match="another geometry"):
        make_commit(MADE.meta, {}, MIDDLE)
    with pytest.raises(BadInputError, match="make two of it"):
        make_commit(MADE.meta, {cell_key((0, 0, 0)): random_evidence(0, SMALL)}, SMALL)


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (with_meta(SUM_VERSION), "bad_commit"),
        (with_meta(EPOCH_VERSION), "bad_commit"),
        (with_meta(marks=None), "bad_commit"),
        (with_meta(marks=[]), "bad_commit"),
        (with_meta(5), "unknown_version"),
        (with_meta(geometry=None, layers=json.loads(epoch_commit().text)["layers"]), "bad_commit"),
        (with_meta(epoch=3), "bad_commit"),
        (with_meta(marks=[json.loads(mark().to_json())] * (MARKS_MAX + 1)), "too_many_marks"),
        (with_meta(retracts=[f"{WREN}.{n}" for n in range(AMENDED_MAX + 1)]), "bad_commit"),
        (with_meta(retracts=IDS, marks=[json.loads(mark().to_json())] * (MARKS_MAX // AMENDED_MAX + 1)), "bad_commit"),
        (commit_bytes(MADE.text, {cell_key((0, 0, 0)): b"cell"}, version=MARK_VERSION), "bad_commit"),
        (with_mark(kind="Hot spot"), "bad_commit"),
        (with_mark(name=""), "bad_commit"),
        (with_mark(name="n" * 65), "bad_commit"),
        (with_mark(name="two\nlines"), "bad_commit"),
        (with_mark(name="\x1b[2J"), "bad_commit"),
        (with_mark(note="from right \u202e to left"), "bad_commit"),
        (with_mark(note="from right \u200f to left"), "bad_commit"),
        (with_mark(name="no\u200bwidth"), "bad_commit"),
        (with_mark(name="\u00a0 \u3000"), "bad_commit"),
        (with_mark(name="\u200d"), "bad_commit"),
        (with_mark(note="\ud800"), "bad_commit"),
        (with_mark(note="n" * 1025), "bad_commit"),
        (with_mark(by="a\u2028b"), "bad_commit"),
        (with_mark(place_mm=[0, 0]), "bad_commit"),
        (with_mark(place_mm=[0.5, 0, 0]), "bad_commit"),
        (with_mark(place_mm=[0, 0, MILLIMETRES_MAX + 1]), "bad_commit"),
        (with_mark(place_mm=[0, 0, 1 << 80]), "bad_commit"),
        (with_mark(extent_mm=[0, -1, 0]), "bad_commit"),
        (with_mark(time_ms=10**14 + 1), "bad_commit"),
        (with_mark(attachment={"sha256": "0" * 64, "size_bytes": 0}), "bad_commit"),
        (with_mark(attachment={"sha256": "0" * 64, "size_bytes": ATTACHMENT_BYTES_MAX + 1}), "bad_commit"),
        (with_mark(attachment={"sha256": "0" * 64, "size_bytes": 1.5}), "bad_commit"),
        (with_mark(attachment={"sha256": "F" * 64, "size_bytes": 1}), "bad_commit"),
        (with_mark(attachment={"sha256": "../../etc", "size_bytes": 1}), "bad_commit"),
        (with_mark(attachment={"sha256": "0" * 64, "size_bytes": 1, "name": "x.html"}), "bad_commit"),
        (with_mark(attachment=[]), "bad_commit"),
        (with_mark(time_ms=True), "bad_commit"),
        (with_mark(value=1), "bad_commit"),
    ],
)
def test_commits_that_contradict_are_refused(data: bytes, kind: str) -> None:
    assert refusal(data) == kind


@given(st.integers(0, len(MADE.data) - 1))
def test_cut_bytes_are_refused(size: int) -> None:
    assert refusal(MADE.data[:size]) in ("bad_commit", "too_large")


@given(st.integers(0, len(MADE.data) - 1), st.integers(1, 255))
def test_flipped_bytes_are_refused_or_another_commit(at: int, flip: int) -> None:
    data = bytearray(MADE.data)
    data[at] ^= flip
    try:
        opened, _ = open_commit(bytes(data))
    except CairnError as exc:
        assert len(exc.message) < 1000
    else:
        assert opened.sha != MADE.sha


COMMITS = [
    MADE,
    mark_commit(0, mark(), author=WREN),
    mark_commit(1, mark("lamp, off"), retracts=(f"{ROBOT}.0",)),
    mark_commit(1, mark("lamp, broken"), author="operator.0011223344556677", retracts=(f"{ROBOT}.0",)),
    mark_commit(2, mark("gone"), author=WREN),
    make_commit(CommitMeta(id=f"{WREN}.3", geometry=SMALL.digest().hex(), retracts=(f"{WREN}.2",)), {}, SMALL),
]


def test_any_order_gives_the_same_marks_and_every_author_has_its_own() -> None:
    metas = [commit.meta for commit in COMMITS]
    expected = living_marks(metas)
    # Equal marks of two robots are two; two edits of one mark are two; what was taken out before it came stays out.
    assert [(str(key), found.name) for key, found in expected.items()] == [
        (f"{ROBOT}.1:0", "lamp, off"),
        ("operator.0011223344556677.1:0", "lamp, broken"),
        (f"{WREN}.0:0", "lamp"),
    ]
    chance = random.Random(0)
    for _ in range(50):
        again = metas + chance.sample(metas, 2)
        chance.shuffle(again)
        assert list(living_marks(again).items()) == list(expected.items())


def test_text_and_key_are_inverse() -> None:
    key = MarkKey(commit_id_from_text(f"{ROBOT}.12"), 3)
    assert mark_key_from_text(str(key)) == key
    assert mark_key_from_text(str(key.commit)) == MarkKey(key.commit, 0)
    for text in ("", "mole", f"{ROBOT}.12:", f"{ROBOT}.12:01", f"{ROBOT}.12:99999", f"{ROBOT}.12:0:1"):
        with pytest.raises(BadInputError) as refused:
            mark_key_from_text(text)
        assert refused.value.kind == "bad_id"


def test_a_mark_is_made_of_metres_and_of_text_as_people_write_it() -> None:
    made = mark("Tu\u0308r", at_m=(0.0004, -1.2346, 2.0), extent_m=(1, 0, 0.001), note="a\r\nb", time_s=1.5)
    assert (made.name, made.place_mm, made.extent_mm, made.note, made.time_ms) == (
        *("T\u00fcr", (0, -1235, 2000), (1000, 0, 1), "a\nb", 1500),
    )
    assert (made.low_mm, made.high_mm) == ((-500, -1235, 1999), (500, -1235, 2001))


@pytest.mark.parametrize(
    ("fields", "kind", "said"),
    [
        ({"at_m": (float("nan"), 0, 0)}, "bad_place", "finite"),
        ({"at_m": (0.0, 0.0)}, "bad_place", "three"),
        ({"at_m": (1e30, 0, 0)}, "bad_place", "within"),
        ({"extent_m": (0, 0, 1.7e308)}, "bad_place", "within"),
        ({"extent_m": (-1, 0, 0)}, "bad_place", "0 m or more"),
        ({"name": "x" * 65}, "bad_mark", "name"),
        ({"name": "bell\x07"}, "bad_mark", "U\\+0007 at 4"),
        ({"note": "tab\there"}, "bad_mark", "U\\+0009"),
        ({"kind": "hot spot"}, "bad_mark", "kind"),
        ({"time_s": float("nan")}, "bad_mark", "time"),
        ({"time_s": 1e30}, "bad_mark", "time"),
    ],
)
def test_a_maker_is_told_what_is_wrong(fields: dict[str, Any], kind: str, said: str) -> None:
    with pytest.raises(BadInputError, match=said) as refused:
        mark(**fields)
    assert refused.value.kind == kind


def test_a_place_beyond_the_lattice_is_refused() -> None:
    edge_m = (1 << 20) * SMALL.side * SMALL.voxel_edge_um / 1e6
    check_place(mark(at_m=(-edge_m, 0, 0)), SMALL)
    with pytest.raises(BadInputError, match="ends") as refused:
        check_place(mark(at_m=(0, edge_m, 0)), SMALL)
    assert refused.value.kind == "bad_place"
