"""Grids of discs over lenses of 40 to 150 degrees: found, named, and as certain as stated; none where there is none.

A small share of `python -m tests.board_finding`, which `make soak` runs at length.
"""

import numpy as np
import pytest
from tests.board_finding.disc_trials import EMPTY_BOARDS, disc_trial, false_grids
from tests.board_finding.empty_images import KINDS, SMALL, empty_image
from tests.fixtures.lengths import length

WHOLE, CUT = range(length(6, long=12)), range(1000, 1004)
EMPTY = range(length(4 * len(KINDS), long=8 * len(KINDS)))
"""Each kind of image, and another board for each seed."""


@pytest.mark.slow
def test_discs_through_lenses_of_all_angles_are_found_and_as_certain_as_stated() -> None:
    trials = [disc_trial(seed) for seed in WHOLE]
    assert sum(each.is_found for each in trials) >= len(trials) - 1, [str(each) for each in trials if not each.is_found]
    sigmas = np.concatenate([each.sigmas for each in trials])
    assert (sigmas > 3).mean() < 0.01
    assert 0.7 < np.sqrt((sigmas**2).mean()) < 1.3


# Parabolas through neighbours alone miss by a fifth of a pitch there. 5181: 97 degrees, but as much perspective.
@pytest.mark.parametrize("seed", [5015, 5041, 5181, 5203])
def test_a_near_board_of_few_discs_behind_a_wide_lens_is_found(seed: int) -> None:
    each = disc_trial(seed)
    assert each.is_found, str(each)


@pytest.mark.slow
def test_discs_that_the_border_cuts_are_left_out_and_the_others_keep_their_names() -> None:
    trials = [disc_trial(seed, whole=False) for seed in CUT]
    assert not [str(each) for each in trials if each.is_wrong]
    assert sum(each.is_found for each in trials) >= len(trials) // 2


@pytest.mark.slow
def test_no_grid_of_discs_is_found_in_images_without_a_board() -> None:
    assert len(EMPTY_BOARDS) > 2
    assert not [seed for seed in EMPTY if false_grids(empty_image(seed, sizes=SMALL)[1], seed)]
