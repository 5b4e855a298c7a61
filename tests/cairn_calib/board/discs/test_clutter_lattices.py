"""Lattices that clutter makes are refused before any outline is fitted, which is what takes long."""

import tracemalloc
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.board_images import DISCS, TOF, picture, pose

from cairn_calib.board.board import Board
from cairn_calib.board.discs import disc_outline, local_map
from cairn_calib.board.discs.blobs import dark_blobs
from cairn_calib.board.discs.disc_gates import ground_refusal, is_regular, rim_refusal, seen_min
from cairn_calib.board.discs.disc_grid import find_circles
from cairn_calib.board.discs.disc_lattice import NamedDiscs, Place, has_room, name_discs, walks
from cairn_calib.board.discs.grid_outlines import expect_grid, fit_grid

BOARD = Board(pattern="circles", columns=4, rows=3, pitch_m=0.09, disc_m=0.06)
SHAPE = (400, 500)


def lattice(columns: int, rows: int) -> dict[Place, int]:
    return {(i, j): j * columns + i for j in range(rows) for i in range(columns)}


def ceiling(columns: int, rows: int) -> npt.NDArray[np.uint8]:
    """Dark holes, 20 px apart."""
    y, x = np.mgrid[: 20 * rows, : 20 * columns]
    values = 190 - 130 / (1 + np.exp(np.hypot(x % 20 - 9.5, y % 20 - 9.5) - 6))
    return np.pad(values + np.random.default_rng(0).normal(0, 2, values.shape), 20, mode="edge").astype(np.uint8)


def small_chessboard(edge_px: int, blur_px: float) -> npt.NDArray[np.float32]:
    """A chessboard whose outer bright squares run into its margin: 15 others are left, as asymmetric circles lie."""
    board = np.ones((9, 10))
    board[1:-1, 1:-1] = np.indices((7, 8)).sum(axis=0) % 2 == 0
    image = np.full((144, 176), 110.0)
    image[40 : 40 + 9 * edge_px, 50 : 50 + 10 * edge_px] = 60 + 100 * np.kron(board, np.ones((edge_px, edge_px)))
    noise = np.random.default_rng(1).normal(0, 1, image.shape)
    return (cv2.GaussianBlur(image, (0, 0), blur_px) + noise).astype(np.float32)


@pytest.mark.parametrize(("edge_px", "blur_px"), [(6, 1.5), (7, 2.0), (8, 2.0)])
def test_squares_too_small_to_have_corners_are_no_discs(edge_px: int, blur_px: float) -> None:
    board = Board(pattern="asymmetric-circles", columns=3, rows=5, pitch_m=0.05)
    detection = find_circles(small_chessboard(edge_px, blur_px), board, polarity="reversed")
    assert detection.corners is None
    assert any("like its discs: of a chessboard" in each.reason for each in detection.attempts)


@pytest.mark.parametrize(("columns", "rows", "more"), [(4, 3, 0), (6, 5, 14), (5, 4, 7)])
def test_discs_beyond_the_rim_that_made_no_blob_make_a_board_part_of_a_larger_pattern(
    columns: int, rows: int, more: int
) -> None:
    image = ceiling(columns, rows).astype(np.float32)
    blobs = dark_blobs(image, 6.4)
    # 4 x 3 holes of a plate are taken for the board; on the left, above and so on the plate may have another row.
    first = 30.0 + 20.0 * np.array([columns > 4, rows > 3])
    centres = first + 20.0 * BOARD.lattice()
    own = np.array([int(np.linalg.norm(blobs.centres - each, axis=1).argmin()) for each in centres])
    expected = expect_grid(BOARD, blobs, NamedDiscs(own, 0), image.shape)
    assert expected is not None
    found = fit_grid(image, expected)
    assert found is not None
    assert found.kept.all()
    refused = rim_refusal(image, found)
    assert (refused[1].split()[0] if refused else "0") == str(more)


@pytest.mark.parametrize("pitch", [1, 2])
def test_every_other_hole_of_a_plate_is_no_board(pitch: int) -> None:
    image = ceiling(12, 9).astype(np.float32)
    blobs = dark_blobs(image, 6.4)
    centres = 30.0 + 20.0 * pitch * BOARD.lattice()
    own = np.array([int(np.linalg.norm(blobs.centres - each, axis=1).argmin()) for each in centres])
    expected = expect_grid(BOARD, blobs, NamedDiscs(own, 0), image.shape)
    assert expected is not None
    found = fit_grid(image, expected)
    assert found is not None
    assert found.kept.all()
    refused = ground_refusal(image, found)
    assert (refused is not None) == (pitch > 1)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """One item for each outline fitted."""
    done: list[object] = []
    fit = disc_outline._fit

    def counted(*args: Any) -> object:
        done.append(args[1])
        return fit(*args)

    monkeypatch.setattr(disc_outline, "_fit", counted)
    return done


def test_no_outline_is_fitted_in_a_pattern_that_goes_on_beyond_the_board_on_all_sides(fits: list[object]) -> None:
    detection = find_circles(ceiling(10, 8), BOARD, upright=True)
    assert detection.corners is None
    assert any("largest lattice has 80" in each.reason for each in detection.attempts)
    assert not fits


def test_a_board_is_still_fitted(fits: list[object]) -> None:
    assert find_circles(ceiling(4, 3), BOARD, upright=True).corners is not None
    assert len(fits) >= BOARD.count


def test_a_lattice_has_room_for_a_board_that_it_does_not_surround() -> None:
    assert has_room(lattice(4, 3), BOARD, beyond_max=0)
    assert has_room(lattice(2, 2), BOARD, beyond_max=0)
    assert has_room(lattice(3, 4), BOARD, beyond_max=0)
    assert not has_room(lattice(5, 4), BOARD, beyond_max=2)
    assert has_room({**lattice(4, 3), (4, 0): 12}, BOARD, beyond_max=1)
    assert not has_room({**lattice(4, 3), (4, 0): 12}, BOARD, beyond_max=0)


def test_a_lattice_without_room_gains_none_as_it_grows() -> None:
    rng = np.random.default_rng(5)
    without = 0
    for _ in range(60):
        size = rng.integers(3, 7, 2)
        whole = [(int(i), int(j)) for i in range(size[0]) for j in range(size[1])]
        part = [place for place in whole if rng.random() < 0.9]
        if part and not has_room(dict.fromkeys(part, 0), BOARD, beyond_max=1):
            without += 1
            assert not has_room(dict.fromkeys(whole, 0), BOARD, beyond_max=1)
    assert without > 10


def test_names_are_those_of_a_search_place_by_place() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        places = [(i, j) for i in range(6) for j in range(5) if rng.random() < 0.8]
        walk = {place: n for n, place in enumerate(places)}
        centres = np.array(places) * 30.0 + rng.normal(0, 1, (len(places), 2))
        found = name_discs(walk, BOARD, centres, upright=False)
        most = max((met - beyond for met, beyond in every_place(walk)), default=0)
        assert {int(each.met.sum()) - each.beyond for each in found} <= {most}
        assert bool(found) == (most >= BOARD.count / 2)


def every_place(walk: dict[Place, int]) -> list[tuple[int, int]]:
    """Discs under a 4 x 3 board and next to it, wherever and however it lies."""
    found = []
    for width, height in ((4, 3), (3, 4)):
        for x in range(-6, 12):
            for y in range(-6, 12):
                own = {(x + i, y + j) for i in range(width) for j in range(height)}
                rim = {(i + a, j + b) for i, j in own for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))} - own
                found.append((len(own & walk.keys()), len(rim & walk.keys())))
    return found


def test_blobs_of_a_board_are_regular_with_strays_and_scattered_ones_are_not() -> None:
    rng = np.random.default_rng(7)
    places = np.array(list(lattice(4, 3)), np.float64)
    at = 60 + 70 * places + 0.05 * 70 * (places[:, ::-1] ** 2)
    shapes = np.tile(20.0 * np.eye(2), (12, 1, 1))
    assert is_regular(places, at, shapes, SHAPE, step=1.0)
    for stray in range(12):
        assert is_regular(places, at + 25.0 * (np.arange(12) == stray)[:, None], shapes, SHAPE, step=1.0)
    assert not is_regular(places, at + rng.normal(0, 25, at.shape), shapes, SHAPE, step=1.0)
    long = shapes @ np.diag([1.5, 0.7])
    assert not is_regular(places, at, long, SHAPE, step=1.0)
    # Folded: the same place twice.
    assert not is_regular(places, np.zeros_like(at), shapes, SHAPE, step=1.0)


def test_a_fit_that_ends_early_is_a_refusal_and_one_that_does_not_is_the_same() -> None:
    rng = np.random.default_rng(1)
    image = picture(TOF, pose(rng, TOF, board=DISCS, tilt_deg=25), rng, board=DISCS).astype(np.float32)
    blobs = dark_blobs(image, 3.2)
    walk = next(walks(blobs, DISCS.count))
    named: NamedDiscs = name_discs(walk, DISCS, blobs.centres, upright=False)[0]
    expected = expect_grid(DISCS, blobs, named, image.shape)
    assert expected is not None
    whole = fit_grid(image, expected)
    assert whole is not None
    least = seen_min(int(whole.in_view.sum()))
    early = fit_grid(image, expected, least=least)
    assert early is not None
    assert np.array_equal(early.pixels, whole.pixels, equal_nan=True)
    assert fit_grid(image, expected, least=DISCS.count + 1) is None
    hidden = image.copy()
    hidden[:, : image.shape[1] // 2] = float(np.median(image))
    assert fit_grid(hidden, expected, least=least) is None


def test_a_local_map_takes_the_memory_of_a_part_and_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    known, places = rng.uniform(0, 20, (400, 2)), rng.uniform(0, 20, (2000, 2))
    pixels = 10 * known + rng.normal(0, 0.1, known.shape)
    tracemalloc.start()
    parts = local_map.local_map(known, pixels, places)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 30e6
    monkeypatch.setattr(local_map, "PAIRS_MAX", 1 << 30)
    for part, whole in zip(parts, local_map.local_map(known, pixels, places), strict=True):
        np.testing.assert_array_equal(part, whole)
