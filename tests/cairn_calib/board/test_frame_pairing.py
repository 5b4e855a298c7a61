"""Pairing of images by their names: one moment is one text, found by comparing names or by --frame."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_calib.board.frame_pairing import frames_of, pairing_table, refuse_unpaired
from cairn_map.errors import BadInputError

CAMERAS = st.sampled_from(["left", "right", "cam0", "cam1", "cam12", "thermal-left", "IR_2", "c1"])
SEPARATORS = st.sampled_from(["-", "_", ".", "--"])
NAMES = st.sampled_from(
    [
        "{camera}{s}{count}",
        "{count}{s}{camera}",
        "{camera}{s}{count}{s}raw",
        "2026-11-21{s}{camera}{s}{count}",
        "20261121{s}120000{s}{camera}{s}{count}",
        "frame{count}{s}{camera}",
        "session7{s}{camera}{s}{count}",
        "{count}",
    ]
)
COUNTS = st.lists(
    st.from_regex(r"[0-9]{1,19}", fullmatch=True) | st.integers(0, 400).map(lambda n: f"{n:04d}"),
    min_size=2,
    max_size=12,
    unique=True,
)


@given(NAMES, SEPARATORS, CAMERAS, CAMERAS, COUNTS)
def test_the_same_count_is_one_frame_of_all_cameras_and_another_count_never_is(
    name: str, separator: str, one: str, other: str, counts: list[str]
) -> None:
    frames = [
        frames_of([name.format(camera=camera, s=separator, count=count) for count in counts]) for camera in (one, other)
    ]
    assert frames[0] == frames[1]
    assert len(set(frames[0])) == len(counts)
    assert all(frame.endswith(count) for frame, count in zip(frames[0], counts, strict=True))


@given(st.lists(st.from_regex(r"[a-c1-3_-]{1,8}", fullmatch=True), min_size=1, max_size=8, unique=True))
def test_names_of_other_words_or_numbers_are_other_frames(names: list[str]) -> None:
    frames = frames_of(names)
    parts = [tuple(re.findall(r"[0-9]+|[a-z]+", name)) for name in names]
    for n, part in enumerate(parts):
        for k in range(n):
            assert frames[n] != frames[k] or part == parts[k]


@given(COUNTS, COUNTS)
def test_a_frame_is_a_text_and_no_number(ours: list[str], theirs: list[str]) -> None:
    shared = set(frames_of([f"left{count}" for count in ours])) & set(frames_of([f"{count}-cam2" for count in theirs]))
    assert shared == set(ours) & set(theirs)


@pytest.mark.parametrize(
    ("names", "frames"),
    [
        (["left01", "left02", "left14"], ["01", "02", "14"]),
        (["0001-cam1", "0002-cam1"], ["0001", "0002"]),
        (["cam0_0003", "cam0_0004"], ["0003", "0004"]),
        (["200", "0200"], ["200", "0200"]),
        (["1403636579763555584", "1403636579813555584"], ["1403636579763555584", "1403636579813555584"]),
        (["2026-11-21_tof_3", "2026-11-22_tof_4"], ["2026-11-21-3", "2026-11-22-4"]),
        (["left01", "left02_retake"], ["01", "02-retake"]),
        (["left03"], ["03"]),
        (["corner", "middle"], ["corner", "middle"]),
        (["board"], ["board"]),
    ],
)
def test_frames_of_names_as_cameras_write_them(names: list[str], frames: list[str]) -> None:
    assert frames_of(names) == frames


def test_an_expression_says_which_part_of_a_name_counts() -> None:
    assert frames_of(["a0200b7", "c200d8"], r"0*([1-9][0-9]*)[bd]") == ["200", "200"]
    with pytest.raises(BadInputError, match=r"must have one group, .* has 0"):
        frames_of(["left01"], "[0-9]+")
    with pytest.raises(BadInputError, match="is no regular expression"):
        frames_of(["left01"], "([0-9]+")
    with pytest.raises(BadInputError, match="finds nothing in left and 1 more"):
        frames_of(["left", "right", "left3"], "([0-9]+)$")


def test_cameras_that_share_no_frame_or_one_alone_are_refused() -> None:
    examples = {"left": "left_200.png is 200"}
    refuse_unpaired({"left": ["1"]}, examples)
    refuse_unpaired({"left": ["1", "2"], "right": ["1", "2", "3"], "tof": ["2", "3"]}, examples)
    with pytest.raises(BadInputError, match=r"no board was seen by right together with left.*\(left_200.png is 200\)"):
        refuse_unpaired({"left": ["200", "201"], "right": ["0200", "0201"]}, examples)
    with pytest.raises(BadInputError, match="tof and left, right saw the board together in one frame alone, 3"):
        refuse_unpaired({"left": ["1", "2", "3"], "right": ["1", "2"], "tof": ["3", "4"]}, examples)


def test_the_table_counts_the_frames_that_two_cameras_share() -> None:
    table = pairing_table(
        {"left": ["10", "9", "8", "7", "6", "5", "4"], "right": ["9", "10"]}, {"left": "l10.png is 10"}
    )
    assert table.splitlines() == [
        "camera  boards  frame of a name  frames",
        "left         7  l10.png is 10    4, 5, 6 ... 8, 9, 10",
        "right        2                   9, 10",
        "frames that both saw: left and right 2",
    ]
    three = pairing_table({name: ["1", "2"] for name in ("a", "b", "c")}, {})
    assert three.splitlines()[-1] == "frames that any two of them both saw: 2"
