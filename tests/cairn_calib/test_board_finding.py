"""A small share of `python -m tests.board_finding`, which `make soak` runs at length."""

import os

import pytest
from tests.board_finding.empty_images import SMALL, empty_image, real_images
from tests.board_finding.trials import found_rightly, trial
from tests.cairn_calib.board_images import BOARD

from cairn_calib.corner_detection import find_chessboard

EMPTY = int(os.environ.get("EMPTY_IMAGES", "60"))


@pytest.mark.parametrize(("name", "seeds"), [("tof", range(12)), ("thermal", (0, 1, 4)), ("colour", (2,))])
def test_boards_are_found_near_far_tilted_blurred_and_reversed(name: str, seeds: range | tuple[int, ...]) -> None:
    missed = [seed for seed in seeds if not found_rightly(trial(name, seed))]
    assert not missed


def test_no_grid_is_found_in_images_without_a_board() -> None:
    real = real_images()
    images = (empty_image(seed, real, sizes=SMALL)[1] for seed in range(EMPTY))
    assert not [seed for seed, image in enumerate(images) if find_chessboard(image, BOARD).corners is not None]
