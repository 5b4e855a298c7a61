"""Picture of a map: the same occupied voxels by colour, temperature and probability, as far as they were measured.

Where no colour camera looked, the first view is by height. A view is as large as its panel lets it be; a scale that
ends below the highest value has a mark at its end, with that value.

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
FONT = (cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
"""Face, size and thickness of letters."""
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
    beyond: str = ""
    """Highest value, if the palette ends below it."""


def write_map_picture(path: Path, voxels: Voxels, *, voxel_edge_m: float, ceiling_m: float | None = None) -> None:
    """Write a PNG with views of the occupied voxels, one for each quantity that was measured.

    Args:
        path: of the PNG.
        voxels: occupied ones; may be none.
        voxel_edge_m: edge of a voxel.
        ceiling_m: voxels above this height are left out, to look inside rooms.
    """
    keep = _in_frame(voxels, ceiling_m)
    numbers = voxels.numbers[keep]
    views = [_draw(panel, numbers, keep) for panel in _panels(voxels, keep)]
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


def _panels(voxels: Voxels, keep: npt.NDArray[np.bool_]) -> list[Panel]:
    """Views of what was measured; scales are those of the voxels that are drawn."""
    colour, thermal = voxels.of_kind(ChannelKind.COLOUR), voxels.of_kind(ChannelKind.TEMPERATURE)
    named = voxels.of_kind(ChannelKind.CLASSES)
    panels = list[Panel]()
    if colour is not None and (colour.weight[keep] > 0).any():
        panels.append(Panel("colour", colours(voxels)))
    elif colour is None and named is not None and (named.weight[keep] > 0).any():
        panels.append(Panel("class", colours(voxels)))
    else:
        heights = voxels.centres_m[:, 2]
        panels.append(_scalar_panel("height (no colour measured)", heights, keep, cv2.COLORMAP_VIRIDIS, "{:.2f} m"))
    if thermal is not None and (thermal.weight[keep] > 0).any():
        celsius = thermal.mean - ZERO_CELSIUS_K
        panels.append(_scalar_panel("temperature (apparent)", celsius, keep, cv2.COLORMAP_INFERNO, "{:.1f} deg C"))
    panels.append(_scalar_panel("probability", voxels.probability, keep, cv2.COLORMAP_CIVIDIS, "{:.2f}"))
    return panels


def _scalar_panel(title: str, values: Floats, keep: npt.NDArray[np.bool_], palette: int, form: str) -> Panel:
    """Panel of values painted between the outer percentiles of those that are drawn; grey where there is none."""
    known = np.isfinite(values)
    rgb = np.full((len(values), 3), UNKNOWN, np.uint8)
    drawn = values[known & keep]
    if not len(drawn):
        return Panel(title, rgb)
    low, high = np.percentile(drawn, PERCENTILES)
    level = np.clip((values[known] - low) / max(high - low, 1e-9), 0, 1)
    rgb[known] = _painted((DARKEST + level * (255 - DARKEST)).astype(np.uint8), palette)
    end, highest = form.format(high), form.format(drawn.max())
    return Panel(title, rgb, palette, form.format(low), end, "" if end == highest else highest)


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
        end = panel.high
        if panel.beyond:
            # An arrow head at the end of the palette, in its last colour: it goes on.
            tip = np.array([[width - MARGIN_PX, 4], [width - 4, 13], [width - MARGIN_PX, 22]], np.int32)
            cv2.fillConvexPoly(legend, tip, [int(level) for level in bar[-1]])
            end = f"{panel.high}, highest {panel.beyond}"
        (text_px, _), _ = cv2.getTextSize(end, *FONT)
        _text(legend, end, (width - MARGIN_PX - text_px, 44))
    return np.vstack([title, image, legend])


def _draw_cubes(image: Rgb, numbers: npt.NDArray[np.int64], rgb: Rgb) -> None:
    """Paint visible faces into the image, far voxels first."""
    # Stage 1: a parallel projection, with the middle of what is drawn in the middle of the panel.
    away = _axes()[2]
    scale = _scale_px(numbers)
    low, high = _extent(numbers)
    plane = _plane()
    offset = np.array([image.shape[1], image.shape[0]]) / 2 - (low + high) / 2 * scale
    # Stage 2: of each cube the three faces towards the viewer.
    occupied = {tuple(number) for number in numbers.tolist()}
    toward = [1 if away[axis] < 0 else -1 for axis in range(3)]
    faces = [_face(axis, toward[axis]) @ plane * scale for axis in range(3)]
    origins = numbers @ plane * scale + offset
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


def _plane() -> Floats:
    """(3, 2) projection of a place in voxels to the picture's right and down."""
    right, down, _ = _axes()
    return np.stack([right, down], axis=1)


def _extent(numbers: npt.NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Lowest and highest (right, down) of the voxels' cubes, in edges: not of their box, whose corners may be empty."""
    corners = np.array([[c >> axis & 1 for axis in range(3)] for c in range(8)]) @ _plane()
    places = numbers @ _plane()
    return places.min(axis=0) + corners.min(axis=0), places.max(axis=0) + corners.max(axis=0)


def _scale_px(numbers: npt.NDArray[np.int64]) -> float:
    """Pixels along a voxel's edge, with which the voxels fill a panel."""
    low, high = _extent(numbers)
    return float(((np.array(PANEL_PX) - 2 * MARGIN_PX) / (high - low)).min())


def _text(image: Rgb, text: str, at: tuple[int, int]) -> None:
    face, size, thickness = FONT
    cv2.putText(image, text, at, face, size, TEXT, thickness, cv2.LINE_AA)
