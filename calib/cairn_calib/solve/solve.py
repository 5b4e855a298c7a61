"""A rig from the corners that its cameras found, in the stages of Kocmanova et al., III.

corners -> homographies -> Zhang -> each camera alone, with distortion        camera_alone.py
-> relative poses, spanning tree                                      rig_start.py
-> all cameras, all boards (and ranges) together                      adjustment.py
-> rig.json with covariance

views = read_board_views({"tof": Path("corners/tof"), "left": Path("corners/left")})
solution = solve_rig(views, usual_plan({"tof": Spectrum.RANGE, "left": Spectrum.COLOUR}))
solution.rig, solution.sigmas()
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cairn_calib.rig.poses import Transform
from cairn_calib.rig.range_terms import NODE_SIGMA_M
from cairn_calib.solve.adjustment import Adjusted, Problem, Sensor, adjust, resumed
from cairn_calib.solve.board_views import BoardViews
from cairn_calib.solve.camera_alone import CameraAlone, camera_alone
from cairn_calib.solve.corner_residuals import CornerData, corner_data, corner_misses
from cairn_calib.solve.normal_equations import Uncertainty, uncertainty
from cairn_calib.solve.pixel_pattern import Pattern, pixel_pattern
from cairn_calib.solve.priors import one, usual_priors
from cairn_calib.solve.range_choice import RangeSpans, chosen_terms, range_spans
from cairn_calib.solve.range_nodes import NODES
from cairn_calib.solve.range_residuals import RangeData, range_data
from cairn_calib.solve.rig_start import rig_start
from cairn_calib.solve.rig_state import Layout, RigState, layout_of, value_of, warp_shape
from cairn_calib.solve.solve_plan import SolvePlan
from cairn_calib.solve.zhang import mirrored_pose
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

SMOOTH_M = 5e-4
"""Of what blocks of pixels add: from there on nodes are solved for."""
RANGE_SIGMA_M = 0.01
"""Stated noise of a range; what it really is, is estimated."""


@dataclass(frozen=True, slots=True)
class Solution:
    """A rig, all that was estimated with it, and how certain it is."""

    views: BoardViews
    """Those that were used."""
    plan: SolvePlan
    adjusted: Adjusted
    known: Uncertainty
    turned: tuple[tuple[str, str], ...] = ()
    """(camera, frame) of views left out, for their corners were named from the wrong end."""
    spans: RangeSpans | None = None
    """What the range images covered; None: there are none."""
    pattern: Pattern | None = None
    """What the range camera's pixels add of their own; None: it was not looked for."""

    @property
    def ranges(self) -> RangeData | None:
        """Those of the boards that were used; None: there are none."""
        last = self.adjusted.problem.sensors[-1].data
        return last if isinstance(last, RangeData) else None

    @property
    def layout(self) -> Layout:
        """Which parameter is which."""
        return self.adjusted.problem.layout

    @property
    def state(self) -> RigState:
        """The estimate."""
        return self.adjusted.state

    @property
    def covariance(self) -> Floats:
        """(P, P) of the shared parameters, in the order of `layout.names`."""
        return self.known.shared

    def sigmas(self) -> dict[tuple[str, str], float]:
        """Standard deviation of each shared parameter, by owner and name; poses: of the error, rad and m."""
        return dict(zip(self.layout.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def values(self) -> dict[tuple[str, str], float]:
        """The shared parameters, by owner and name; those of poses, which are errors, 0."""
        return dict(zip(self.layout.names, value_of(self.state, self.layout).tolist(), strict=True))


def solve_rig(views: BoardViews, plan: SolvePlan) -> Solution:
    """The rig that meets the corners best.

    Raises:
        BadInputError: the views do not determine it; the message says what to shoot.
    """
    if set(views.cameras) != set(plan.cameras):
        raise BadInputError(
            "unknown_camera", f"the plan is of {', '.join(plan.cameras)}, the views of {', '.join(views.cameras)}"
        )
    alone = {name: camera_alone(name, views, plan) for name in plan.cameras}
    weights = {(view.camera, view.frame): float(view.corners.seen.sum()) for view in views.views}
    start = rig_start({name: each.T_camera_board for name, each in alone.items()}, views.board, plan.gauge, weights)
    views = views.without(start.turned)
    state = _first_state(views, plan, alone, start.T_rig_camera)
    solution = solve_from(views, plan, state, {name: each.scale for name, each in alone.items()})
    return replace(_with_pixels(solution), turned=start.turned)


def _with_pixels(solution: Solution) -> Solution:
    """The solution with what the range camera's pixels add, solved on with nodes where that is smooth."""
    found = pixel_pattern(solution.views, solution.adjusted, solution.covariance)
    if found is not None and found.smooth_m >= SMOOTH_M:
        done = _with_nodes(solution.adjusted, solution.views, solution.plan)
        solution = replace(solution, adjusted=done, known=uncertainty(done.normal))
        found = pixel_pattern(solution.views, done, solution.covariance)
    return replace(solution, pattern=found)


def _with_nodes(done: Adjusted, views: BoardViews, plan: SolvePlan) -> Adjusted:
    """The minimum with a grid of nodes in the range bias, too, from one without."""
    *corners, last = done.problem.sensors
    if not isinstance(last.data, RangeData):
        return done
    owner, lens = list(plan.cameras)[last.data.camera], done.state.lenses[last.data.camera]
    terms = replace(last.data.terms, nodes=NODES)
    more = terms.names[len(terms.document_names) :]
    layout = layout_of(plan, dict(zip(plan.cameras, done.state.lenses, strict=True)), [(owner, n) for n in terms.names])
    priors = (*done.problem.priors, *(one(owner, name, 0.0, NODE_SIGMA_M) for name in more))
    sensors = (*corners, replace(last, data=last.data.with_terms(terms, lens)))
    state = replace(done.state, bias=np.append(done.state.bias, np.zeros(len(more))))
    try:
        return resumed(Problem(views.board, layout, sensors, priors), state, plan.noise)
    except np.linalg.LinAlgError as exc:
        raise BadInputError("not_observable", f"the images do not determine the range bias ({exc}): take more") from exc


def solve_from(views: BoardViews, plan: SolvePlan, state: RigState, scales: Mapping[str, float]) -> Solution:
    """The joint solve alone: from a state of the plan's cameras and the views' frames, and first scales of noise.

    Raises:
        BadInputError: the views do not determine it.
    """
    names = list(plan.cameras)
    lenses = dict(zip(names, state.lenses, strict=True))
    counts = {name: len(views.of_camera(name)) for name in names}
    state = replace(state, bias=np.zeros(0))
    layout = layout_of(plan, lenses, [])
    sensors = tuple(
        _corner_sensor(n, views, scales[name] if plan.noise.rounds else 1.0) for n, name in enumerate(names)
    )
    priors = usual_priors(plan, lenses, counts, views.board, ranges=None)
    done = _adjusted(Problem(views.board, layout, sensors, priors), state, plan)
    ranged = _range_data(views, plan, done.state)
    if ranged is None:
        return Solution(views, plan, done, uncertainty(done.normal))
    spans = range_spans(ranged, done.state, views.board)
    wanted = plan.range_terms or chosen_terms(spans, plan.modulation_hz)
    terms = replace(wanted, nodes=None)
    owner = names[ranged.camera]
    priors = usual_priors(plan, lenses, counts, views.board, ranges=(owner, terms))
    layout = layout_of(plan, lenses, [(owner, name) for name in terms.names])
    ranged = ranged.with_terms(terms, done.state.lenses[ranged.camera])
    sensors = (*done.problem.sensors, Sensor(ranged, 1.0, ranged.measured))
    problem = Problem(views.board, layout, sensors, priors)
    done = _adjusted(problem, replace(done.state, bias=np.zeros(len(terms.names))), plan)
    if wanted.nodes is not None:
        done = _with_nodes(done, views, plan)
    return Solution(views, plan, done, uncertainty(done.normal), spans=spans)


def _adjusted(problem: Problem, state: RigState, plan: SolvePlan) -> Adjusted:
    try:
        return adjust(problem, state, plan.noise)
    except np.linalg.LinAlgError as exc:
        raise BadInputError(
            "not_observable", f"the images do not determine all of the rig ({exc}): take more, with the board tilted"
        ) from exc


def _corner_sensor(camera: int, views: BoardViews, scale: float) -> Sensor:
    data = corner_data(camera, views.of_camera(views.cameras[camera]), views.frames)
    return Sensor(data, scale, data.seen)


def _range_data(views: BoardViews, plan: SolvePlan, state: RigState) -> RangeData | None:
    owners = {each.camera for each in views.ranges}
    if len(owners) > 1:
        raise BadInputError("bad_board_views", f"one camera of a rig measures ranges, got {', '.join(sorted(owners))}")
    if not owners:
        return None
    camera = list(plan.cameras).index(owners.pop())
    return range_data(camera, views.ranges, views.frames, state, views.board, sigma_m=RANGE_SIGMA_M)


def _first_state(
    views: BoardViews, plan: SolvePlan, alone: Mapping[str, CameraAlone], T_rig_camera: Mapping[str, Transform]
) -> RigState:
    names = list(plan.cameras)
    lenses = tuple(alone[name].lens for name in names)
    placed = np.stack([T_rig_camera[name] for name in names])
    blank = RigState(lenses, placed, np.zeros((len(views.frames), 4, 4)), np.zeros(2), 1.0, np.zeros(0))
    board = (views.board.points(), warp_shape(views.board))
    data = [corner_data(n, views.of_camera(name), views.frames) for n, name in enumerate(names)]
    middle = views.board.points().mean(axis=0)
    candidates: list[list[Transform]] = [[] for _ in views.frames]
    for name in names:
        for view in views.of_camera(name):
            T = alone[name].T_camera_board[view.frame]
            candidates[views.frames.index(view.frame)] += [
                T_rig_camera[name] @ each for each in (T, mirrored_pose(T, middle))
            ]
    # Each round tries one more reading of every frame's board in all cameras.
    best, least = blank, np.full(len(views.frames), np.inf)
    for turn in range(max(map(len, candidates))):
        poses = np.stack([each[min(turn, len(each) - 1)] for each in candidates])
        misses = _missed(data, replace(blank, T_rig_board=poses), board)
        better = misses < least
        best = replace(best, T_rig_board=np.where(better[:, None, None], poses, best.T_rig_board))
        least = np.where(better, misses, least)
    return best


def _missed(data: list[CornerData], state: RigState, board: tuple[Floats, Floats]) -> Floats:
    """(F,) by how much corners miss in all cameras: a sum that no single camera can blow up."""
    missed = np.zeros(len(state.T_rig_board))
    for each in data:
        width = state.lenses[each.camera].width
        off = np.linalg.norm(corner_misses(each, state, *board), axis=2) / width
        missed[each.frames] += np.minimum(np.nan_to_num(off, nan=1.0), 1.0).sum(axis=1)
    return missed
