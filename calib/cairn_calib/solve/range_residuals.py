"""Range residuals against the board's plane: the range camera's share of the normal equations.

    true range = (n . (o - c) + w) / (n . v)      n, o: the board's normal and origin, w: its warp there; v: the pixel's
    residual   = (true + bias - measured) / s     ray, c: the camera; all in the rig's frame, metres

Every pixel that looks at the inside of the board measures its plane, whatever is printed on it. Of an image of
z-depth z the residual is ((true + bias) v_z - z) / (s u_z): v_z is the ray's third component in the camera's frame,
u_z the same by the lens of the start, which is kept. With z / v_z as the measured range instead, noise would stand on
the side of the lens, and pull its focal length (by a quarter of its sigma in a simulation).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.range_terms import ALWAYS, RangeTerms, off_middle
from cairn_calib.rig.raster import Raster
from cairn_calib.solve.board_views import RangeView
from cairn_calib.solve.normal_equations import Block, Indices, Loss
from cairn_calib.solve.range_nodes import PixelNodes, pixel_nodes
from cairn_calib.solve.rig_state import ParameterLayout, RigState, warp_at_places
from cairn_map.arrays import Flags, Floats

PIXELS_MAX = 400
"""Pixels of one image that count, evenly spread: more would only repeat them."""
PIXELS_MIN = 12
"""Pixels on the board without which an image is left out."""
AMPLITUDE_FULL = 65535
"""Amplitude, counts, at which a pixel is saturated and its range is void."""
WARP_ROUNDS = 3
"""Rounds of intersecting a ray with the bent board; each is a thousand times nearer."""
INSIDE = 0.0
"""Pitches inside the outermost corners that a pixel's middle must be: half a cell of board is around them."""


@dataclass(frozen=True, slots=True)
class RangeData:
    """Ranges of one camera, V views of at most M pixels; `measured` is False where there is none."""

    camera: int
    frames: Indices
    """(V,)"""
    pixels: Floats
    """(V, M, 2)"""
    given_m: Floats
    """(V, M) measured ranges along the beam; of z-depth by the lens of the start."""
    measured: Flags
    """(V, M)"""
    sigma_m: float
    """Expected standard deviation."""
    amplitude: Floats
    """(V, M) counts; NaN where unknown."""
    terms: RangeTerms = ALWAYS
    """Shapes of the bias."""
    nodes: PixelNodes | None = None
    """Nodes around each pixel; None where `terms` has no nodes."""
    along_axis: Floats | None = None
    """(V, M) of z-depth: third component of the pixels' rays by the lens of the start; None: ranges along the beam."""

    def range_m(self, rays_camera: Floats) -> Floats:
        """(V, M) measured ranges along the beam, for the pixels' (V, M, 3) unit rays."""
        return self.given_m / self.along(rays_camera)

    def along(self, rays_camera: Floats) -> Floats:
        """(V, M) v_z / u_z of z-depth; 1 of ranges along the beam."""
        return np.ones_like(self.given_m) if self.along_axis is None else rays_camera[..., 2] / self.along_axis

    def shapes(self, raster: Raster, range_m: Floats) -> Floats:
        """(V, M, D) metres that one unit of each of `terms`, except nodes, adds to (V, M) true ranges."""
        return self.terms.shapes(range_m, off_middle(raster, self.pixels), self.terms.faintness(self.amplitude))

    def added_m(self, raster: Raster, range_m: Floats, bias: Floats) -> Floats:
        """(V, M) metres that a bias (B,) adds to (V, M) true ranges."""
        smooth = self.shapes(raster, range_m) @ bias[: len(self.terms.document_names)]
        return smooth if self.nodes is None else smooth + self.nodes.values(bias[len(self.terms.document_names) :])

    def slope(self, range_m: Floats, bias: Floats) -> Floats:
        """(V, M) change of the measured range per metre of true range."""
        return 1 + self.terms.slopes(range_m) @ bias[: len(self.terms.document_names)]

    def with_terms(self, terms: RangeTerms, raster: Raster) -> "RangeData":
        """The same ranges for a bias of other shapes."""
        nodes = None if terms.nodes is None else pixel_nodes(raster, self.pixels, terms.nodes)
        return replace(self, terms=terms, nodes=nodes)


def range_data(
    camera: int,
    views: Sequence[RangeView],
    frames: Sequence[str],
    state: RigState,
    board: Board,
    *,
    sigma_m: float,
    pixels_max: int = PIXELS_MAX,
) -> RangeData | None:
    """Ranges of the pixels that look at the board, whose pose a first solution gives; None where there are hardly any.

    Raises:
        BadInputError: an image has another size than the camera.
    """
    # Pixels of each image on the board, with a range and no saturation.
    lens = state.lenses[camera]
    chosen = []
    for view in views:
        if view.frame not in frames:
            continue
        lens.check_image(view.range_m, name=f"range image of frame {view.frame}")
        amplitude = _known_amplitude(view, lens)
        # A saturated pixel has a range, but a wrong one.
        readable = np.isfinite(view.range_m) & ~(amplitude >= AMPLITUDE_FULL)
        pixels = _inside(readable, lens.rays(), state, camera, frames.index(view.frame), board, pixels_max)
        if len(pixels) >= PIXELS_MIN:
            x, y = pixels.T
            chosen.append((frames.index(view.frame), pixels, view.range_m[y, x], amplitude[y, x]))
    if not chosen:
        return None
    # Rows of equal length, padded with what was not measured.
    width = max(len(pixels) for _, pixels, _, _ in chosen)
    pixels_px, range_m = np.zeros((len(chosen), width, 2)), np.ones((len(chosen), width))
    measured, amplitude = np.zeros((len(chosen), width), bool), np.full((len(chosen), width), np.nan)
    for n, (_, pixels, ranges, amplitudes) in enumerate(chosen):
        pixels_px[n, : len(pixels)], range_m[n, : len(pixels)] = pixels, ranges
        amplitude[n, : len(pixels)], measured[n, : len(pixels)] = amplitudes, True
    indices = np.array([frame for frame, _, _, _ in chosen], np.intp)
    data = RangeData(camera, indices, pixels_px, range_m, measured, sigma_m, amplitude)
    if not any(view.is_z_depth for view in views):
        return data
    along_axis = lens.unproject(pixels_px)[..., 2]
    return replace(data, given_m=range_m / along_axis, along_axis=along_axis)


def plane_ranges(data: RangeData, state: RigState, board: Board) -> tuple[Floats, Floats]:
    """(V, M) ranges at which the pixels' rays meet the board, and those that were measured, metres."""
    rays = state.lenses[data.camera].unproject(data.pixels)
    return _intersect_board(data, state, board, rays).range_m, data.range_m(rays)


def range_block(data: RangeData, state: RigState, layout: ParameterLayout, board: Board, loss: Loss) -> Block:
    """The camera's share of the normal equations; its noise is `sigma_m` times the loss's scale."""
    c = data.camera
    seen = state.lenses[c].unprojection(data.pixels)
    hits = _intersect_board(data, state, board, seen.rays)
    R_rig_camera = state.T_rig_camera[c, :3, :3]
    shapes = data.shapes(state.lenses[c], hits.range_m)
    # Names as in the head of this module.
    n, v, d, slant = hits.normals, hits.rays, hits.range_m, hits.slant
    # Derivatives of the true range d = (n . (o - c) + w) / (n . v): by the ray v, thus by the intrinsics; ...
    by_ray = -(d / slant)[..., None] * n
    columns = [
        np.squeeze((by_ray @ R_rig_camera)[..., None, :] @ seen.by_intrinsics, -2)[..., layout.intrinsic_columns[c]]
    ]
    at = [layout.intrinsic_at[c]]
    # ... by the camera's rotation and place, the warp, and the board's rotation and place.
    if len(layout.pose_at[c]):
        columns += [np.cross(v, by_ray), -n / slant[..., None]]
        at.append(layout.pose_at[c])
    if len(layout.warp_at):
        columns.append(hits.warp_shape / slant[..., None])
        at.append(layout.warp_at)
    columns += [np.cross(n, hits.off_board) / slant[..., None], n / slant[..., None]]
    # The measured range moves by `slope` with the true one. Columns of the bias stand before the board's two.
    slope = data.slope(hits.range_m, state.bias)
    along = data.along(seen.rays)
    columns = [(slope * along)[..., None] * column for column in columns]
    predicted_m = d + data.added_m(state.lenses[c], d, state.bias)
    if data.along_axis is not None:
        # v_z moves with the lens.
        by_v_z = predicted_m / data.along_axis
        columns[0] = columns[0] + by_v_z[..., None] * seen.by_intrinsics[..., 2, layout.intrinsic_columns[c]]
    columns.insert(-2, along[..., None] * shapes)
    at.append(layout.bias_at[: shapes.shape[-1]])
    # Whiten, weigh by the loss, and sum.
    noise_m = loss.scale * data.sigma_m
    missed = along * predicted_m - data.given_m
    residuals = np.where(data.measured, missed / noise_m, 0.0)
    weights, cost = loss(residuals**2)
    root = np.sqrt(weights)
    # Derivatives are NaN where a ray misses the board's plane or a pixel has no ray; those pixels do not count.
    J = np.nan_to_num(np.concatenate(columns, axis=-1) * (root / noise_m)[..., None])
    J_t = np.swapaxes(J, 1, 2)
    pull = -(J_t @ (root * residuals)[..., None])[..., 0]
    block = Block(np.concatenate(at), data.frames, J_t @ J, pull, residuals[..., None], cost)
    if data.nodes is None:
        return block
    root_a_metre = along * root * data.measured / noise_m
    return _with_nodes(block, data.nodes, J, root_a_metre, root * residuals, layout.bias_at[shapes.shape[-1] :])


def _with_nodes(
    block: Block, nodes: PixelNodes, J: Floats, root_a_metre: Floats, residuals: Floats, at: Indices
) -> Block:
    """Block with the nodes' columns before the others.

    Args:
        block: the block of all other parameters.
        nodes: the nodes around each pixel.
        J: (V, M, J) weighted derivatives by the other parameters.
        root_a_metre: (V, M) roots of the weights, 1 / m, which are the derivatives by a node of share 1.
        residuals: (V, M) weighted.
        at: positions of the nodes' columns.
    """
    # Sparse sums (`range_nodes.py`): nodes with all others and the residuals, and nodes with nodes.
    count = nodes.count
    sums = nodes.products(root_a_metre[..., None] * np.concatenate([J, residuals[..., None]], axis=-1))
    cross, pull = sums[:, :-1], -sums[:, -1]
    square = np.empty((len(cross), *(2 * (count + cross.shape[1],))))
    square[:, :count, :count] = nodes.squares(root_a_metre**2)
    square[:, count:, :count], square[:, :count, count:] = cross, np.swapaxes(cross, 1, 2)
    square[:, count:, count:] = block.square
    return replace(block, at=np.concatenate([at, block.at]), square=square, pull=np.concatenate([pull, block.pull], 1))


@dataclass(frozen=True, slots=True)
class _Intersections:
    """Intersections of rays with the board, in the rig's frame."""

    normals: Floats
    """(V, M, 3) normals of the bent board there; of length 1 except for the bend."""
    rays: Floats
    """(V, M, 3)"""
    slant: Floats
    """(V, M) n . v"""
    range_m: Floats
    """(V, M)"""
    off_board: Floats
    """(V, M, 3) from the intersection to the board's origin."""
    warp_shape: Floats
    """(V, M, 2)"""


def _intersect_board(data: RangeData, state: RigState, board: Board, rays_camera: Floats) -> _Intersections:
    T_rig_camera, T_rig_board = state.T_rig_camera[data.camera], state.T_rig_board[data.frames]
    R_rig_board = T_rig_board[:, :3, :3]
    n = R_rig_board[:, :, 2]
    v = rays_camera @ T_rig_camera[:3, :3].T
    slant = np.einsum("vi,vmi->vm", n, v)
    offset = T_rig_board[:, :3, 3] - T_rig_camera[:3, 3]
    # The flat board first; then the warp at the place that the round before found, n . (o - c) + w = d (n . v).
    flat_m = np.einsum("vi,vi->v", n, offset)[:, None] / slant
    range_m, places, shape = flat_m, np.empty(0), np.empty(0)
    for _ in range(WARP_ROUNDS):
        places = (range_m[..., None] * v - offset[:, None]) @ R_rig_board
        shape = warp_at_places(board, places[..., :2])
        range_m = flat_m + (shape @ state.warp_m) / slant
    # The bent board's normal, from the slopes of its two parabolas (`warp_at_places`).
    last = board.points()[:, :2].max(axis=0)
    slopes = -4 / last * (2 * places[..., :2] / last - 1) * state.warp_m
    local = np.concatenate([-slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1) @ np.swapaxes(R_rig_board, 1, 2)
    slant = np.einsum("vmi,vmi->vm", local, v)
    return _Intersections(local, v, slant, range_m, offset[:, None] - range_m[..., None] * v, shape)


def _known_amplitude(view: RangeView, lens: Lens) -> Floats:
    """(H, W) amplitude, counts; NaN where there is no image of it, or a count of 0."""
    if view.amplitude is None:
        return np.full(view.range_m.shape, np.nan)
    lens.check_image(view.amplitude, name=f"amplitude image of frame {view.frame}")
    counts = view.amplitude.astype(np.float64)
    return np.where(counts > 0, counts, np.nan)


def _inside(
    readable: Flags, rays: Floats, state: RigState, camera: int, frame: int, board: Board, pixels_max: int
) -> npt.NDArray[np.intp]:
    """(M, 2) pixels whose rays meet the board inside its corners, of those that are readable."""
    # Intersect every pixel's ray with the flat board, in the camera's frame.
    T_camera_board = np.linalg.inv(state.T_rig_camera[camera]) @ state.T_rig_board[frame]
    n, o = T_camera_board[:3, 2], T_camera_board[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = (rays * ((n @ o) / (rays @ n))[..., None] - o) @ T_camera_board[:3, :2]
        last = board.points()[:, :2].max(axis=0)
        inside = ((places > INSIDE * board.pitch_m) & (places < last - INSIDE * board.pitch_m)).all(axis=-1)
        inside &= readable & (rays @ n * (n @ o) > 0)
    y, x = np.nonzero(inside)
    # Every n-th pixel, so that at most `pixels_max` stay, spread over the board.
    step = max(1, -(-len(x) // pixels_max))
    return np.stack([x, y], axis=-1)[::step]
