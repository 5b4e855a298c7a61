"""Undistorted picture of a board: a pinhole's view of an image, with lines along the board's rows and columns.

What is straight in the world is straight in a pinhole's image. Where corners of a row leave the line through them, the
lens is not yet understood (or the board is bent); the picture as it was taken shows what the lens does.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from cairn_calib.board.corner_pictures import resampled
from cairn_calib.board.corners import Corners
from cairn_calib.report.page import Figure
from cairn_calib.report.report_images import ReportImage
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.lens import Lens
from cairn_map.arrays import Floats

WIDTH_PX = 640
SLOPE_MAX = 2.5
"""Largest slope of a ray in the pinhole's view: 68 degrees off the axis. A fisheye sees more; no plane shows that."""
POINTS_MIN = 3
"""Points of a row that make a line worth looking at."""


@dataclass(frozen=True, slots=True)
class BoardLine:
    """A row or a column of a board: the straight line through its points."""

    ends: Floats
    """(2, 2) places of its first and last point, moved onto the line."""
    off: Floats
    """(N,) distances of its points from the line."""


def board_lines(corners: Corners, places: Floats) -> list[BoardLine]:
    """Lines through rows and columns of a board, by total least squares, of (N, 2) places of its points (NaN: hidden).

    Of asymmetric circles, rows alone, and every second column's points; of named points, none.
    """
    if corners.board.named is not None:
        return []
    grid = places.reshape(corners.board.rows, corners.board.columns, 2)
    along = [grid[row] for row in range(len(grid))]
    if corners.board.pattern == "asymmetric-circles":
        along += [grid[start::2, column] for start in (0, 1) for column in range(grid.shape[1])]
    else:
        along += [grid[:, column] for column in range(grid.shape[1])]
    return [_line(each[np.isfinite(each[:, 0])]) for each in along if np.isfinite(each[:, 0]).sum() >= POINTS_MIN]


def _line(points: Floats) -> BoardLine:
    middle = points.mean(axis=0)
    _, _, directions = np.linalg.svd(points - middle)
    along = (points - middle) @ directions[0]
    return BoardLine(middle + along[[0, -1], None] * directions[0], (points - middle) @ directions[1])


def rms_off(lines: Sequence[BoardLine]) -> float:
    """Root mean square distance of all points from their lines."""
    return float(np.sqrt(np.mean(np.concatenate([line.off for line in lines]) ** 2)))


def straight_figure(lens: Lens, images: Sequence[ReportImage]) -> Figure | None:
    """The image in which the lens bends the board's lines most, undistorted; None if no image has a picture."""
    shown = [(each, corners) for each in images if each.source is not None and (corners := each.document.to_corners())]
    bent = [
        (rms_off(lines), each, corners) for each, corners in shown if (lines := board_lines(corners, corners.pixels))
    ]
    if not bent:
        return None
    before_px, image, corners = max(bent, key=lambda each: each[0])
    view = pinhole_view(lens)
    rays = lens.unproject(corners.pixels)
    # Behind the view's plane a pinhole sees nothing.
    rays[rays[:, 2] <= 0] = np.nan
    lines = board_lines(corners, view.project(rays))
    x, y = np.meshgrid(np.arange(view.width), np.arange(view.height))
    source = lens.project(view.unproject(np.stack([x, y], axis=-1).astype(np.float64)))
    picture = resampled(image.source, (lens.width, lens.height), source) if image.source else None
    if picture is None or not lines:
        return None
    # As pixels of the image, so that both figures compare.
    after_px = rms_off(lines) * lens.focal_px[0] / view.focal_px[0]
    name = image.document.image
    return Figure(
        _svg(view, picture, lines, name),
        f"{name}, undistorted: straight lines through the board's rows and columns. Corners leave them by "
        f"{after_px:.2g} px rms, by {before_px:.2g} px in the image as it was taken; what is straight in the scene "
        "must be straight here",
    )


def pinhole_view(lens: Lens) -> Camera:
    """A pinhole that sees what a lens sees, as far as a plane can show it, 640 pixels wide."""
    columns, rows = np.arange(lens.width, dtype=np.float64), np.arange(lens.height, dtype=np.float64)
    border = np.concatenate(
        [np.stack([columns, np.full(lens.width, y)], axis=-1) for y in (0.0, lens.height - 1.0)]
        + [np.stack([np.full(lens.height, x), rows], axis=-1) for x in (0.0, lens.width - 1.0)]
    )
    rays = lens.unproject(border)
    seen = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0)]
    slopes = seen[:, :2] / seen[:, 2:] if len(seen) else np.array([[-SLOPE_MAX, -SLOPE_MAX], [SLOPE_MAX, SLOPE_MAX]])
    low, high = np.clip([slopes.min(axis=0), slopes.max(axis=0)], -SLOPE_MAX, SLOPE_MAX)
    if len(seen) < len(rays):
        # Part of the border looks nowhere, or backwards: the plane ends first.
        low, high = np.minimum(low, -SLOPE_MAX), np.maximum(high, SLOPE_MAX)
    focal = (WIDTH_PX - 1) / (high[0] - low[0])
    height = max(2, round(focal * (high[1] - low[1])) + 1)
    return Camera(width=WIDTH_PX, height=height, focal_px=(focal, focal), centre_px=tuple(-low * focal))


def _svg(view: Camera, picture: bytes, lines: Sequence[BoardLine], name: str) -> str:
    data = base64.b64encode(picture).decode()
    path = "".join(f"M{x:.2f} {y:.2f}L{u:.2f} {v:.2f}" for (x, y), (u, v) in (line.ends for line in lines))
    return (
        f'<svg viewBox="-0.5 -0.5 {view.width} {view.height}" role="img" aria-label="{escape(name)}, undistorted">'
        f'<image x="-0.5" y="-0.5" width="{view.width}" height="{view.height}" href="data:image/jpeg;base64,{data}"/>'
        f'<path d="{path}" fill="none" stroke="#ff5a1f" stroke-width="1"/></svg>'
    )
