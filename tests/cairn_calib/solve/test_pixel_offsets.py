"""Offset of each pixel of a range camera: found with its uncertainty, stated, taken off, never made up."""

import json
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.calib.simulated_views import SPECTRA, TOF, World, ranges_of, views_of, world

from cairn_calib.diagnosis.range_warnings import range_warnings
from cairn_calib.diagnosis.solve_warnings import warnings_of
from cairn_calib.rig.pixel_offsets import UNIT_M, PixelOffsets, pixel_offsets
from cairn_calib.rig.range_terms import ALWAYS, BIAS_NAMES, off_middle_image
from cairn_calib.rig.rig import Rig, rig_from_json
from cairn_calib.solve.normal_equations import Loss
from cairn_calib.solve.range_nodes import NODES, pixel_nodes
from cairn_calib.solve.range_residuals import range_block
from cairn_calib.solve.rig_state import step_state
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve import SMOOTH_M, solve_rig
from cairn_calib.solve.solve_plan import usual_plan
from cairn_calib.solve.solved_rig import solved_rig
from cairn_map.errors import BadInputError

Floats = npt.NDArray[np.float64]

PAIR = ("tof", "left")
PATTERN_M, NOISE_M = 0.006, 0.006
HOT = (70, 88)
"""Row and column of a pixel that is 15 cm off."""


def solved(truth: World) -> Solution:
    views = replace(views_of(truth, seed=4), ranges=ranges_of(truth, "tof", seed=4, sigma_m=NOISE_M))
    return solve_rig(views, usual_plan({name: SPECTRA[name] for name in truth.names}))


@pytest.fixture(scope="module")
def pattern_m() -> Floats:
    pattern = PATTERN_M * np.random.default_rng(1).normal(size=(144, 176))
    pattern[HOT] = 0.15
    return pattern


@pytest.fixture(scope="module")
def solution(pattern_m: Floats) -> Solution:
    return solved(world(24, seed=4, names=PAIR, bias=(0.04, 0.006, 0.03, -0.02), pattern_m=pattern_m))


@pytest.fixture(scope="module")
def rig(solution: Solution) -> Rig:
    return rig_from_json(solved_rig(solution, made_s=0.0).to_json())


def stated(rig: Rig) -> PixelOffsets:
    bias = rig["tof"].range_bias
    assert bias is not None and bias.pixel_offsets is not None
    return bias.pixel_offsets


def test_a_fixed_pattern_is_found_within_its_sigmas(rig: Rig, pattern_m: Floats) -> None:
    found = stated(rig)
    assert found.pattern_sigma_m == pytest.approx(PATTERN_M, rel=0.05)
    assert found.noise_sigma_m == pytest.approx(NOISE_M, rel=0.05)
    usual = np.arange(pattern_m.size).reshape(pattern_m.shape) != HOT[0] * 176 + HOT[1]
    pulls = (found.offset_m - pattern_m) / found.sigma_m
    for low, high in ((1, 1), (2, 4), (5, 8), (9, 255)):
        chosen = usual & (found.counts >= low) & (found.counts <= high)
        assert chosen.sum() > 300
        assert np.sqrt(np.mean(pulls[chosen] ** 2)) == pytest.approx(1, abs=0.1)
    often = usual & (found.counts >= 9)
    assert np.std((found.offset_m - pattern_m)[often]) < 0.35 * PATTERN_M


def test_a_pixel_that_is_far_off_every_time_is_known(rig: Rig) -> None:
    assert stated(rig).counts[HOT] >= 5
    assert stated(rig).offset_m[HOT] == pytest.approx(0.15, abs=0.03)


def test_pixels_without_a_board_have_no_offset_and_all_of_the_uncertainty(rig: Rig, solution: Solution) -> None:
    found = stated(rig)
    blind = found.counts == 0
    assert 0.5 < blind.mean() < 0.8
    assert (found.offset_m[blind] == 0).all()
    np.testing.assert_allclose(found.sigma_m[blind], found.pattern_sigma_m, atol=UNIT_M)
    assert found.sigma_m[~blind].max() < 0.8 * found.pattern_sigma_m
    warned = next(each for each in range_warnings(solution) if each.kind == "range_pixels")
    assert warned.measured == pytest.approx(blind.mean(), abs=1e-6) and warned.threshold == 0.1
    assert f"{1000 * found.unseen_sigma_m:.1f} mm" in warned.text
    image = rig["tof"].range_sigma_image(np.full((144, 176), 1.0))
    assert image[blind].min() > image[found.counts > 8].max()
    mean = float(rig["tof"].range_sigma_m(np.array(1.0)))
    assert image[found.counts > 8].mean() < mean < image[blind].max()


def test_ranges_of_other_boards_are_truer_pixel_by_pixel(rig: Rig, pattern_m: Floats) -> None:
    other = world(4, seed=9, names=PAIR, bias=(0.04, 0.006, 0.03, -0.02), pattern_m=pattern_m)
    measured = ranges_of(other, "tof", seed=1, sigma_m=1e-9)
    exact = ranges_of(replace(other, bias=(0.0,) * 4, pattern_m=None), "tof", seed=1, sigma_m=1e-9)
    often = stated(rig).counts >= 6
    bias = rig["tof"].range_bias
    smooth = rig["tof"].model_copy(update={"range_bias": bias and bias.model_copy(update={"pixel_offsets": None})})
    spread = []
    for each in (rig["tof"], smooth):
        off = [(each.true_ranges(a.range_m) - b.range_m)[often] for a, b in zip(measured, exact, strict=True)]
        spread.append(np.nanstd(np.concatenate(off)))
    assert spread[0] < 0.5 * PATTERN_M < PATTERN_M < spread[1]


SMOOTH_BIAS = (0.04, 0.006, 0.03, -0.01)


@pytest.fixture(scope="module")
def smooth_m() -> Floats:
    y, x = np.mgrid[:144, :176]
    return np.asarray(0.01 * np.sin(x / 20) * np.sin(y / 20))


@pytest.fixture(scope="module")
def with_nodes(smooth_m: Floats) -> Solution:
    return solved(world(16, seed=4, names=PAIR, bias=SMOOTH_BIAS, pattern_m=smooth_m))


def test_a_range_image_s_share_is_the_slope_of_its_cost(with_nodes: Solution) -> None:
    problem, layout = with_nodes.adjustment.problem, with_nodes.layout
    used = with_nodes.ranges
    assert used is not None
    loss = Loss(1.0, used.measured, np.inf)
    rng = np.random.default_rng(0)
    scale = with_nodes.covariance.diagonal() ** 0.5
    frames = len(with_nodes.state.T_rig_board)
    start = step_state(with_nodes.state, layout, 0.3 * scale * rng.normal(size=layout.size), np.zeros((frames, 6)))
    block = range_block(used, start, layout, problem.board, loss)
    for _ in range(3):
        shared, boards = 1e-3 * scale * rng.normal(size=layout.size), 1e-6 * rng.normal(size=(frames, 6))
        up, down = (
            range_block(used, step_state(start, layout, sign * shared, sign * boards), layout, problem.board, loss).cost
            for sign in (1, -1)
        )
        step = np.concatenate([np.tile(shared[block.at], (len(block.frames), 1)), boards[block.frames]], axis=1)
        assert (up - down) / 2 == pytest.approx(-2 * np.sum(block.pull * step), rel=1e-4)
        curved = np.einsum("vi,vij,vj->", step, block.square, step)
        assert up + down - 2 * block.cost == pytest.approx(2 * curved, rel=0.05)


def test_what_varies_smoothly_over_the_image_is_solved_for_with_the_boards_places(
    with_nodes: Solution, smooth_m: Floats
) -> None:
    solution, pattern_m, bias = with_nodes, smooth_m, SMOOTH_BIAS
    used, found = solution.ranges, solution.pattern
    assert used is not None and used.terms.nodes == NODES and found is not None and found.offsets is not None
    assert found.smooth_m < SMOOTH_M
    values, sigmas = solution.values(), solution.sigmas()
    pulls = [(values["tof", name] - right) / sigmas["tof", name] for name, right in zip(BIAS_NAMES, bias, strict=True)]
    assert np.abs(pulls).max() < 3  # without nodes the corner's part is 7 sigmas off
    rig = rig_from_json(solved_rig(solution, made_s=0.0).to_json())
    stated_bias = rig["tof"].range_bias
    assert stated_bias is not None and stated_bias.names == BIAS_NAMES
    true_m, off = np.full((144, 176), 2.0), off_middle_image(176, 144)
    measured = true_m + ALWAYS.shapes(true_m, off, np.zeros_like(off)) @ np.array(bias) + pattern_m
    miss_m = rig["tof"].true_ranges(measured) - true_m
    often = found.offsets.counts >= 3
    assert 0.2 < np.sqrt(np.mean((miss_m / stated_bias.sigma_image(TOF, true_m))[often] ** 2)) < 1.2
    assert np.std(miss_m[often]) < 0.5 * np.std(pattern_m[often])
    assert not any(each.text.startswith("node") for each in warnings_of(solution, [], [], None, [], [], []))


def test_sums_by_nodes_are_those_of_full_matrices() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform((-0.5, -0.5), (175.5, 143.5), (2, 30, 2))
    nodes = pixel_nodes(TOF, pixels, (5, 4))
    full = np.zeros((2, 30, 20))
    for place in np.ndindex(2, 30, 4):
        full[(*place[:2], nodes.index[place])] += nodes.share[place]
    np.testing.assert_allclose(full.sum(axis=-1), 1)
    weights, columns = rng.uniform(size=(2, 30)), rng.normal(size=(2, 30, 3))
    np.testing.assert_allclose(nodes.squares(weights), np.einsum("vmk,vm,vml->vkl", full, weights, full), atol=1e-12)
    np.testing.assert_allclose(nodes.products(columns), np.einsum("vmj,vmk->vjk", columns, full), atol=1e-12)
    root = rng.normal(size=(20, 20))
    variances = np.einsum("vmk,kl,vml->vm", full, root @ root.T, full)
    np.testing.assert_allclose(nodes.variances(root @ root.T), variances, atol=1e-12)
    # Linear between nodes, so a plane comes back.
    at = np.stack(np.meshgrid(np.linspace(0, 175, 5), np.linspace(0, 143, 4)), axis=-1).reshape(-1, 2)
    inside = np.clip(pixels, 0, (175, 143))
    np.testing.assert_allclose(nodes.values(at @ [2.0, -3.0]), inside @ [2.0, -3.0], atol=1e-9)


def test_range_images_without_a_board_are_told() -> None:
    views = views_of(world(6, seed=4, names=PAIR), seed=4)
    ranges = ranges_of(world(6, seed=4, names=PAIR), "tof", seed=4, sigma_m=NOISE_M)
    strange = tuple(replace(each, frame=f"1{each.frame}") for each in ranges[:2])
    plan = usual_plan({name: SPECTRA[name] for name in PAIR})
    for given, count in (((*strange, *ranges[2:]), 4), (strange, 0)):
        warned = next(range_warnings(solve_rig(replace(views, ranges=given), plan)))
        assert (warned.kind, warned.measured, warned.threshold) == ("range_images", count, len(given))


@pytest.mark.slow
def test_ranges_of_other_units_other_places_or_along_the_axis_are_not_taken_for_a_bias() -> None:
    truth = world(6, seed=4, names=PAIR)
    views, right = views_of(truth, seed=4), ranges_of(truth, "tof", seed=4, sigma_m=NOISE_M)
    plan = usual_plan({name: SPECTRA[name] for name in PAIR})
    for times in (10.0, 0.1, 0.5):
        wrong = tuple(replace(each, range_m=times * each.range_m) for each in right)
        with pytest.raises(BadInputError, match=rf"are {times:g}\d* times as long .*--range-units-per-m"):
            solve_rig(replace(views, ranges=wrong), plan)
    others = zip(right, (*right[1:], right[0]), strict=True)
    shuffled = tuple(replace(each, range_m=other.range_m) for each, other in others)
    along = tuple(replace(each, range_m=each.range_m * TOF.rays()[..., 2]) for each in right)
    for ranges, kind in ((right, None), (shuffled, "range_noise"), (along, "range_kind")):
        told = {each.kind: each for each in range_warnings(solve_rig(replace(views, ranges=ranges), plan))}
        assert {"range_noise", "range_kind"} & told.keys() == ({kind} if kind else set())
        assert kind is None or told[kind].measured > told[kind].threshold


def test_without_a_pattern_noise_is_not_stored_as_one() -> None:
    solution = solved(world(10, seed=4, names=PAIR))
    assert solution.pattern is not None and solution.pattern.offsets is None
    assert solution.pattern.pairs > 5000 and solution.pattern.at_most_m < 0.002
    assert b"pixel_offsets" not in solved_rig(solution, made_s=0.0).to_json()
    assert "range_pixels" not in {each.kind for each in range_warnings(solution)}


def test_pixels_that_saw_one_board_only_are_told_to_be_unknown(pattern_m: Floats) -> None:
    truth = world(3, seed=4, names=PAIR, pattern_m=pattern_m)
    middle = truth.boards[:, :3, 2].copy()
    boards = truth.boards.copy()
    boards[:, 0, 3] += np.array([-0.9, 0.0, 0.9]) * np.abs(middle[:, 2])  # side by side
    solution = solved(replace(truth, boards=boards))
    warned = next(each for each in range_warnings(solution) if each.kind == "range_pixels")
    assert warned.measured < warned.threshold == 1000 and "hardly a pixel" in warned.text


def test_the_map_comes_back_from_text_and_what_is_damaged_is_refused(rig: Rig) -> None:
    rng = np.random.default_rng(0)
    offset_m, sigma_m = rng.normal(size=(5, 7)), rng.uniform(0, 0.1, (5, 7))
    counts = rng.integers(0, 400, (5, 7))
    one = pixel_offsets(offset_m, sigma_m, counts, pattern_sigma_m=0.1, noise_sigma_m=0.01)
    back = PixelOffsets.model_validate_json(one.model_dump_json())
    np.testing.assert_allclose(back.offset_m, offset_m, atol=UNIT_M / 2)
    assert (back.sigma_m >= sigma_m - 1e-12).all() and (back.sigma_m <= sigma_m + UNIT_M).all()
    np.testing.assert_array_equal(back.counts, np.minimum(counts, 255))
    for name, wrong, told in (
        ("offset", one.offset[:-8], "damaged"),
        ("sigma", "not base64", "damaged"),
        ("count", one.offset, "expected 35 bytes"),
        ("width", 8, "not of 8 x 5 pixels: expected 80 bytes"),
    ):
        with pytest.raises(ValueError, match=told):
            PixelOffsets.model_validate(one.model_dump() | {name: wrong})
    document = json.loads(rig.to_json())
    document["cameras"]["tof"]["range_bias"]["pixel_offsets"] = one.model_dump()
    with pytest.raises(BadInputError, match=r"camera's 176 x 144 pixels, got 7 x 5"):
        rig_from_json(json.dumps(document).encode())
