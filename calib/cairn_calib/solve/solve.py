"""Rig calibration from the corners that its cameras found, in the stages of Kocmanova et al., section III.

1. corners -> homographies -> Zhang -> each camera alone, with distortion            camera_alone.py
2. relative poses of the cameras along a spanning tree; views named from the wrong end are left out   rig_start.py
3. board poses: of every frame's readings, mirrored ones too, the one that all cameras meet best      rig_start.py
4. all cameras and all boards together, by corners alone                             adjustment.py
5. where there are range images: the shapes of the range bias that they determine    range_choice.py
6. corners and ranges together, with that range bias                                 range_residuals.py
7. if the plan asks for it: a grid of nodes in the range bias                        range_nodes.py
8. each pixel's own offset; where these are smooth, stage 7 and this one again       pixel_pattern.py
9. noise with the scatter of frames, where that is more than corners explain         normal_equations.py
10. numbers known before, whose sigmas are enlarged where the images contradict them  known_fit.py

`solve_rig` runs all of them, `solve_from` stages 4 to 7 from a known state. Each of 4, 6 and 7 begins at the minimum of
the one before; 7 keeps its outliers and noise. `solved_rig.py` makes rig.json, with its covariance, of the solution.

views = read_board_views({"tof": Path("corners/tof"), "left": Path("corners/left")})
solution = solve_rig(views, usual_plan({"tof": Spectrum.RANGE, "left": Spectrum.COLOUR}))
rig, sigmas = solved_rig(solution, made_s=time.time()), solution.sigmas()
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cairn_calib.rig.range_terms import NODE_SIGMA_M, RangeTerms
from cairn_calib.solve.adjustment import WARM, Adjustment, AdjustmentProblem, Sensor, adjust, descend, resume
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.camera_alone import camera_alone
from cairn_calib.solve.corner_residuals import corner_data
from cairn_calib.solve.known_fit import fit_known
from cairn_calib.solve.normal_equations import Uncertainty, frame_scatter, uncertainty
from cairn_calib.solve.pixel_pattern import pixel_pattern
from cairn_calib.solve.priors import single_prior, usual_priors
from cairn_calib.solve.range_choice import choose_terms, range_spans
from cairn_calib.solve.range_nodes import NODES
from cairn_calib.solve.range_residuals import RangeData, range_data
from cairn_calib.solve.rig_start import first_state, rig_start
from cairn_calib.solve.rig_state import RigState, parameter_layout
from cairn_calib.solve.solution import Solution
from cairn_calib.solve.solve_plan import FOCAL_AND_CENTRE, Prior, SolvePlan
from cairn_calib.solve.zhang import homography_of
from cairn_map.errors import BadInputError

SMOOTH_M = 5e-4
"""Smooth part of the pixels' own offsets, metres, from which a grid of nodes is solved for: half a millimetre."""
RANGE_SIGMA_M = 0.01
"""Stated noise of a range, metres; the scale of noise that is estimated with the rig corrects it."""
SCATTER_SIGMAS = 3.0
"""Standard deviations by which the scatter of frames must exceed what noise explains, to count."""


def solve_rig(views: BoardViews, plan: SolvePlan) -> Solution:
    """The rig that meets the corners, and ranges, best.

    Raises:
        BadInputError: the views do not determine it; the message says what to shoot.
    """
    if set(views.cameras) != set(plan.cameras):
        raise BadInputError(
            "unknown_camera", f"the plan is of {', '.join(plan.cameras)}, the views of {', '.join(views.cameras)}"
        )
    for name, camera in plan.cameras.items():
        if len(plan.cameras) == 1 and not any(map(camera.is_free, (*FOCAL_AND_CENTRE, *camera.coefficients))):
            raise BadInputError("bad_arguments", f"all of {name} is held, and it is alone: nothing is left to solve")
    # Corners on a line leave a board's place open.
    views = views.without((each.camera, each.frame) for each in views.views if homography_of(each.corners) is None)
    # 1. Each camera alone.
    alone = {name: camera_alone(name, views, plan) for name in plan.cameras}
    # 2. Cameras in the gauge's frame; a view counts by its corners.
    views.refuse_unpaired()
    weights = {(view.camera, view.frame): float(view.corners.seen.sum()) for view in views.views}
    start = rig_start({name: each.T_camera_board for name, each in alone.items()}, views.board, plan.gauge, weights)
    views = views.without(start.reversed_views)
    # 3. Boards in the gauge's frame.
    state = first_state(views, alone, start.T_rig_camera)
    # 4 to 7. Everything together.
    solution = solve_from(views, plan, state, {name: each.scale for name, each in alone.items()})
    # 8 to 10. Each pixel's own offset; the scatter of frames, and what contradicts what was known.
    return replace(_with_scatter(_with_pixels(solution)), reversed_views=start.reversed_views)


def solve_from(views: BoardViews, plan: SolvePlan, state: RigState, scales: Mapping[str, float]) -> Solution:
    """The joint solve alone: from a state of the plan's cameras and the views' frames, and first scales of noise.

    The range bias of `state` is dropped: no range takes part in stage 4, and stage 6 begins with a bias of 0, whose
    shapes are chosen from these views and may be others than those of `state`.

    Raises:
        BadInputError: the views do not determine it.
    """
    # 4. Corners alone.
    by_corners = _solve_corners(views, plan, state, scales)
    ranged = _range_data(views, plan, by_corners.state)
    if ranged is None:
        return Solution(views, plan, by_corners, _uncertainty(by_corners))
    # 5. Shapes of the range bias: the plan's, or those that the images determine.
    spans = range_spans(ranged, by_corners.state, views.board)
    terms = plan.range_terms or choose_terms(spans, plan.modulation_hz)
    # 6. Corners and ranges; nodes, if any, begin at this minimum.
    priors = _priors(views, plan, state, ranges=(list(plan.cameras)[ranged.camera], replace(terms, nodes=None)))
    adjusted = _solve_ranges(by_corners, ranged, plan, replace(terms, nodes=None), priors)
    # 7. Nodes.
    if terms.nodes is not None:
        adjusted = _solve_nodes(adjusted, plan)
    return Solution(views, plan, adjusted, _uncertainty(adjusted), spans=spans)


def _solve_corners(views: BoardViews, plan: SolvePlan, state: RigState, scales: Mapping[str, float]) -> Adjustment:
    """Stage 4: the minimum over cameras and boards, without any range."""
    sensors = []
    for camera, name in enumerate(plan.cameras):
        data = corner_data(camera, views.of_camera(name), views.frames)
        # Without rounds of estimating noise the stated covariances count as they are.
        sensors.append(Sensor(data, scales[name] if plan.noise.rounds else 1.0, data.seen))
    layout = parameter_layout(plan, dict(zip(plan.cameras, state.lenses, strict=True)), [])
    priors = _priors(views, plan, state, ranges=None)
    return _adjust(
        AdjustmentProblem(views.board, layout, tuple(sensors), priors, plan.known),
        replace(state, bias=np.zeros(0)),
        plan,
    )


def _solve_ranges(
    by_corners: Adjustment, ranged: RangeData, plan: SolvePlan, terms: RangeTerms, priors: tuple[Prior, ...]
) -> Adjustment:
    """Stage 6: the minimum over corners and ranges, from the one over corners, with the range bias from 0."""
    state, board = by_corners.state, by_corners.problem.board
    owner = list(plan.cameras)[ranged.camera]
    lenses = dict(zip(plan.cameras, state.lenses, strict=True))
    layout = parameter_layout(plan, lenses, [(owner, name) for name in terms.names])
    ranged = ranged.with_terms(terms, state.lenses[ranged.camera])
    sensors = (*by_corners.problem.sensors, Sensor(ranged, 1.0, ranged.measured))
    problem = AdjustmentProblem(board, layout, sensors, priors, plan.known)
    return _adjust(problem, replace(state, bias=np.zeros(len(terms.names))), plan)


def _solve_nodes(adjusted: Adjustment, plan: SolvePlan) -> Adjustment:
    """Stage 7: the minimum with a grid of nodes in the range bias, too, from one without; the same without ranges."""
    *corners, last = adjusted.problem.sensors
    if not isinstance(last.data, RangeData):
        return adjusted
    lenses = adjusted.state.lenses
    owner, lens = list(plan.cameras)[last.data.camera], lenses[last.data.camera]
    terms = replace(last.data.terms, nodes=NODES)
    added = terms.names[len(terms.document_names) :]
    layout = parameter_layout(
        plan, dict(zip(plan.cameras, lenses, strict=True)), [(owner, name) for name in terms.names]
    )
    priors = (*adjusted.problem.priors, *(single_prior(owner, name, 0.0, NODE_SIGMA_M) for name in added))
    sensors = (*corners, replace(last, data=last.data.with_terms(terms, lens)))
    state = replace(adjusted.state, bias=np.append(adjusted.state.bias, np.zeros(len(added))))
    try:
        problem = replace(adjusted.problem, layout=layout, sensors=sensors, priors=priors)
        return resume(problem, state, plan.noise)
    except np.linalg.LinAlgError as exc:
        raise BadInputError("not_observable", f"the images do not determine the range bias ({exc}): take more") from exc


def _with_pixels(solution: Solution) -> Solution:
    """Stage 8: the solution with each range pixel's own offset, solved on with nodes where these are smooth."""
    pattern = pixel_pattern(solution.views, solution.adjustment, solution.covariance)
    if pattern is not None and pattern.smooth_m >= SMOOTH_M:
        adjusted = _solve_nodes(solution.adjustment, solution.plan)
        solution = replace(solution, adjustment=adjusted, uncertainty=_uncertainty(adjusted))
        pattern = pixel_pattern(solution.views, adjusted, solution.covariance)
    return replace(solution, pattern=pattern)


def _with_scatter(solution: Solution) -> Solution:
    """Stages 9 and 10: the minimum and a covariance for frames that disagree, and numbers that they contradict."""
    if solution.plan.noise.rounds == 0:
        return solution
    done = solution.adjustment
    try:
        done, fits = fit_known(_scattered(done))
        if any(fit.contradicts for fit in fits):
            # Outliers and noise were judged while wrong numbers pulled at all: again, with what these are worth.
            sensors = tuple(replace(each, scatter=1.0) for each in done.problem.sensors)
            again = adjust(replace(done.problem, sensors=sensors), done.state, solution.plan.noise)
            done, fits = fit_known(_scattered(again))
    except np.linalg.LinAlgError as exc:
        raise _open(exc) from exc
    scatter = done.problem.sensors[0].scatter
    return replace(solution, adjustment=done, uncertainty=_uncertainty(done), scatter=scatter, known=fits)


def _scattered(done: Adjustment) -> Adjustment:
    """The minimum with residuals that weigh by the scatter of frames as well, if that is more than noise."""
    problem = done.problem
    try:
        # Where the images alone are at rest: what is known pulls all frames to one side.
        ratio, sigma = frame_scatter(done.blocks, replace(problem, known=()).normal(done.state, done.blocks))
    except np.linalg.LinAlgError:
        ratio, sigma = frame_scatter(done.blocks, done.normal)
    if not ratio > 1 + SCATTER_SIGMAS * sigma:
        return done
    sensors = tuple(replace(each, scatter=ratio) for each in problem.sensors)
    return descend(replace(problem, sensors=sensors), done.state, damping=WARM)


def _adjust(problem: AdjustmentProblem, state: RigState, plan: SolvePlan) -> Adjustment:
    try:
        return adjust(problem, state, plan.noise)
    except np.linalg.LinAlgError as exc:
        raise _open(exc) from exc


def _uncertainty(done: Adjustment) -> Uncertainty:
    try:
        return uncertainty(done.normal)
    except np.linalg.LinAlgError as exc:
        raise _open(exc) from exc


def _open(exc: np.linalg.LinAlgError) -> BadInputError:
    return BadInputError(
        "not_observable", f"the images do not determine all of the rig ({exc}): take more, with the board tilted"
    )


def _priors(
    views: BoardViews, plan: SolvePlan, start: RigState, *, ranges: tuple[str, RangeTerms] | None
) -> tuple[Prior, ...]:
    """Priors by the lenses of the start, so that all stages assume the same."""
    lenses = dict(zip(plan.cameras, start.lenses, strict=True))
    counts = {name: len(views.of_camera(name)) for name in plan.cameras}
    return usual_priors(plan, lenses, counts, views.board, ranges=ranges)


def _range_data(views: BoardViews, plan: SolvePlan, state: RigState) -> RangeData | None:
    owners = {each.camera for each in views.ranges}
    if len(owners) > 1:
        raise BadInputError("bad_board_views", f"one camera of a rig measures ranges, got {', '.join(sorted(owners))}")
    if not owners:
        return None
    camera = list(plan.cameras).index(owners.pop())
    return range_data(camera, views.ranges, views.frames, state, views.board, sigma_m=RANGE_SIGMA_M)
