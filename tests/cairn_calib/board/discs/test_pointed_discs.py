"""Discs that a person pointed at: used whatever the gates say, as long as a disc is there."""

import numpy as np
from tests.fixtures.calib.disc_views import DiscView, disc_view

from cairn_calib.board.corners import Corners
from cairn_calib.board.discs.disc_grid import disc_candidates, fit_pointed_discs

SEEDS = (3, 7, 25)
"""Discs through lenses of 130 degrees, which the finder misses in part or finds with difficulty."""


def pointed(view: DiscView, named: list[int], seed: int) -> Corners:
    rng = np.random.default_rng(seed)
    clicks = view.centroids[named] + rng.normal(size=(len(named), 2)) * 0.08 * view.narrowest_px
    polarity = "reversed" if view.reversed else "normal"
    detection = fit_pointed_discs(view.image, view.board, clicks, polarity=polarity)
    assert detection.corners is not None, (view.text, detection.attempts)
    return detection.corners


def outer(view: DiscView) -> list[int]:
    board = view.board
    return [0, board.columns - 1, board.count - 1, board.count - board.columns]


def test_all_discs_pointed_at_or_the_outer_four_are_enough() -> None:
    for seed in SEEDS:
        view = disc_view(seed)
        for named in (list(range(view.board.count)), outer(view)):
            corners = pointed(view, named, seed)
            off = np.linalg.norm(corners.pixels - view.centroids, axis=1)
            assert np.nanmax(off) < 0.25 * view.narrowest_px, view.text
            assert corners.seen.mean() >= 0.8, view.text


def test_the_image_votes_for_the_polarity_of_discs_pointed_at() -> None:
    view = disc_view(3)
    found = disc_candidates(
        view.image.astype(np.float32), view.board, polarity="vote", upright=True, pointed=view.centroids
    )
    assert found.vote == ("reversed" if view.reversed else "normal")


def test_places_without_discs_are_no_board_however_they_are_pointed_at() -> None:
    view = disc_view(3)
    empty = np.full_like(view.image, 30000) + np.random.default_rng(1).normal(0, 20, view.image.shape).astype(np.uint16)
    detection = fit_pointed_discs(empty, view.board, view.centroids)
    assert detection.corners is None
    assert "point" in detection.attempts[-1].reason
