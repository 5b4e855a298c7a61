"""Picture of a map: the same occupied voxels three times, by colour, temperature and probability.

Voxels are drawn as small cubes in a parallel view from above one corner, far ones first. Only faces that touch no
other occupied voxel are drawn. A closed room shows nothing but its roof, unless the ceiling is cut off.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cairn_fusion.recording.images import write_colour
from cairn_map.arrays import Floats, Rgb
from cairn_map.evidence.channels import ChannelKind
from cairn_map.evidence.voxels import Voxels
from cairn_map.files.cell_files import colours

PANEL_PX = (800, 520)
"""Width and height of one view."""
TITLE_PX = 40
LEGEND_PX = 56
MARGIN_PX = 16
BACKGROUND = (24, 26, 30)
TEXT = (230, 230, 230)
UNKNOWN = (96, 96, 96)
"""Colour of voxels that no camera of that spectrum saw: grey, never the cold end of a palette."""
VIEW_YAW_RAD = np.radians(35.0)
VIEW_PITCH_RAD = np.radians(48.0)
FACE_SHADE = ((0, 0.72), (1, 0.86), (2, 1.0))
"""Brightness of the faces towards the viewer along x, y, z."""
ZERO_CELSIUS_K = 273.15
PERCENTILES = (0.5, 99.8)
FRAME_PERCENTILES = (3, 97)
DARKEST = 36
"""Level of a palette at which painting begins: its first levels are as dark as the background."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One view: title, colour of each voxel (N, 3), and the legend's palette with its two ends in words."""

    title: str
    rgb: Rgb
    palette: int | None = None
    low: str = ""
    high: str = ""


def write_map_picture(path: Path, voxels: Voxels, *, voxel_edge_m: float, ceiling_m: float | None = None) -> None:
    """Write a PNG with three views of the occupied voxels.

    Args:
        path: of the PNG.
        voxels: occupied ones; may be none.
        voxel_edge_m: edge of a voxel.
        ceiling_m: voxels above this height are left out, to look inside rooms.
    """
    keep = _in_frame(voxels, ceiling_m)
    numbers = voxels.numbers[keep]
    views = [_draw(panel, numbers, keep) for panel in _panels(voxels)]
    width = sum(view.shape[1] for view in views)
    footer = np.full((TITLE_PX, width, 3), BACKGROUND, np.uint8)
    note = f"{len(voxels)} occupied voxels of {voxel_edge_m * 100:g} cm"
    if len(numbers):
        up_to = f"up to {ceiling_m:g} m" if ceiling_m is not None else "all heights"
        note += f"; drawn: {up_to}, 1 m = {_scale_px(numbers) / voxel_edge_m:.0f} px"
    _text(footer, note, (MARGIN_PX, 26))
    write_colour(path, np.vstack([np.hstack(views), footer]))


def _in_frame(voxels: Voxels, ceiling_m: float | None) -> npt.NDArray[np.bool_]:
    """(N,) true for voxels to draw: below the ceiling, and no stray ones, for which all others would be drawn small."""
    keep = voxels.centres_m[:, 2] <= (ceiling_m if ceiling_m is not None else np.inf)
    if keep.any():
        low, high = np.percentile(voxels.centres_m[keep], FRAME_PERCENTILES, axis=0)
        slack = 0.1 * (high - low) + 0.05
        keep &= ((voxels.centres_m >= low - slack) & (voxels.centres_m <= high + slack)).all(axis=1)
    return np.asarray(keep)


def _panels(voxels: Voxels) -> list[Panel]:
    panels = [Panel("colour", colours(voxels))]
    thermal = voxels.of_kind(ChannelKind.TEMPERATURE)
    celsius = thermal.mean - ZERO_CELSIUS_K if thermal is not None else np.full(len(voxels), np.nan)
    panels.append(_scalar_panel("temperature (apparent)", celsius, cv2.COLORMAP_INFERNO, "{:.1f} deg C"))
    panels.append(_scalar_panel("probability", voxels.probability, cv2.COLORMAP_CIVIDIS, "{:.2f}"))
    return panels


def _scalar_panel(title: str, values: Floats, palette: int, form: str) -> Panel:
    """Panel of values painted between their outer percentiles; grey where there is none."""
    known = np.isfinite(values)
    rgb = np.full((len(values), 3), UNKNOWN, np.uint8)
    if not known.any():
        return Panel(f"{title}: none measured", rgb)
    low, high = np.percentile(values[known], PERCENTILES)
    level = np.clip((values[known] - low) / max(high - low, 1e-9), 0, 1)
    rgb[known] = _painted((DARKEST + level * (255 - DARKEST)).astype(np.uint8), palette)
    return Panel(title, rgb, palette, form.format(low), form.format(high))


def _painted(levels: npt.NDArray[np.uint8], palette: int) -> Rgb:
    bgr = np.asarray(cv2.applyColorMap(levels.reshape(-1, 1), palette), dtype=np.uint8)
    return np.ascontiguousarray(bgr[:, 0, ::-1])


def _draw(panel: Panel, numbers: npt.NDArray[np.int64], keep: npt.NDArray[np.bool_]) -> Rgb:
    width, height = PANEL_PX
    image = np.full((height, width, 3), BACKGROUND, np.uint8)
    if len(numbers):
        _draw_cubes(image, numbers, panel.rgb[keep])
    title = np.full((TITLE_PX, width, 3), BACKGROUND, np.uint8)
    _text(title, panel.title, (MARGIN_PX, 26))
    legend = np.full((LEGEND_PX, width, 3), BACKGROUND, np.uint8)
    if panel.palette is not None:
        bar = _painted(np.linspace(DARKEST, 255, width - 2 * MARGIN_PX).astype(np.uint8), panel.palette)
        legend[6:20, MARGIN_PX : width - MARGIN_PX] = bar
        _text(legend, panel.low, (MARGIN_PX, 44))
        _text(legend, panel.high, (width - MARGIN_PX - 11 * len(panel.high), 44))
    return np.vstack([title, image, legend])


def _draw_cubes(image: Rgb, numbers: npt.NDArray[np.int64], rgb: Rgb) -> None:
    """Paint visible faces into the image, far voxels first."""
    # Stage 1: a parallel projection, with the middle of the map in the middle of the panel.
    right, down, away = _axes()
    scale = _scale_px(numbers)
    corners = numbers.min(axis=0), numbers.max(axis=0) + 1
    middle = (corners[0] + corners[1]) / 2
    screen = np.array([image.shape[1], image.shape[0]]) / 2
    plane = np.stack([right, down], axis=1)
    # Stage 2: of each cube the three faces towards the viewer.
    occupied = {tuple(number) for number in numbers.tolist()}
    toward = [1 if away[axis] < 0 else -1 for axis in range(3)]
    faces = [_face(axis, toward[axis]) @ plane * scale for axis in range(3)]
    origins = (numbers - middle) @ plane * scale + screen
    shaded = [np.rint(rgb * shade).astype(int).tolist() for _, shade in FACE_SHADE]
    # Stage 3: far voxels first, so that near ones are painted over them.
    for row in np.argsort(-(numbers @ away), kind="stable").tolist():
        at = numbers[row].tolist()
        for axis in range(3):
            if _neighbour(at, axis, toward[axis]) not in occupied:
                outline = np.rint((origins[row] + faces[axis]) * 16).astype(np.int32)
                cv2.fillConvexPoly(image, outline, shaded[axis][row], lineType=cv2.LINE_8, shift=4)


def _neighbour(at: list[int], axis: int, step: int) -> tuple[int, ...]:
    return tuple(value + step if a == axis else value for a, value in enumerate(at))


def _face(axis: int, toward: int) -> Floats:
    """(4, 3) corners of a unit cube's face across an axis, on the viewer's side."""
    u, v = [a for a in range(3) if a != axis]
    corners = np.zeros((4, 3))
    corners[:, axis] = 1 if toward > 0 else 0
    corners[[1, 2], u] = 1
    corners[[2, 3], v] = 1
    return corners


def _axes() -> tuple[Floats, Floats, Floats]:
    """The picture's right and down, and the direction away from the viewer, in map axes."""
    cos_yaw, sin_yaw = np.cos(VIEW_YAW_RAD), np.sin(VIEW_YAW_RAD)
    cos_pitch, sin_pitch = np.cos(VIEW_PITCH_RAD), np.sin(VIEW_PITCH_RAD)
    away = np.array([cos_yaw * cos_pitch, sin_yaw * cos_pitch, -sin_pitch])
    right = np.array([sin_yaw, -cos_yaw, 0.0])
    return right, np.cross(away, right), away


def _scale_px(numbers: npt.NDArray[np.int64]) -> float:
    """Pixels along a voxel's edge, so that all voxels fit into a panel."""
    right, down, _ = _axes()
    low, high = numbers.min(axis=0), numbers.max(axis=0) + 1
    box = np.array([[(low, high)[c >> a & 1][a] for a in range(3)] for c in range(8)], dtype=np.float64)
    spans = np.ptp(box @ np.stack([right, down], axis=1), axis=0)
    return float(min((PANEL_PX[0] - 2 * MARGIN_PX) / spans[0], (PANEL_PX[1] - 2 * MARGIN_PX) / spans[1]))


def _text(image: Rgb, text: str, at: tuple[int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.55, TEXT, 1, cv2.LINE_AA)
