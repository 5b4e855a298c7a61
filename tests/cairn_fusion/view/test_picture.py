"""Pictures of maps: what was measured has a view, and a map fills it."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from tests.fixtures.map.made import PLAIN, SMALL

from cairn_fusion.view.picture import BACKGROUND, LEGEND_PX, MARGIN_PX, PANEL_PX, TITLE_PX, write_map_picture
from cairn_map.evidence.evidence import packed_evidence
from cairn_map.evidence.grid import Geometry, cell_key, split_voxels
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import Voxels, voxels_of_evidence

WALL = [(x, y, z) for x in range(8) for y in range(2) for z in range(8)]


def wall(geometry: Geometry = SMALL, *, shade: int | None = None, kelvin: list[float] | None = None) -> Voxels:
    """A wall in one cell, of one shade, with these temperatures in its first voxels."""
    _, places = split_voxels(np.array(WALL), geometry)
    samples = np.zeros((len(WALL), geometry.plane_count), np.int64)
    if shade is not None:
        samples[:, geometry.planes_of("colour")] = (shade, shade, shade, 1)
    if kelvin is not None:
        channel = geometry.channel("temperature")
        assert channel is not None
        steps = channel.quantise(np.array(kelvin))
        rows = np.stack([steps, steps**2, np.ones_like(steps)], axis=1)
        samples[: len(rows), geometry.planes_of("temperature")] = rows
    evidence = packed_evidence(places, np.tile([3, 0], (len(WALL), 1)), samples, geometry)
    return voxels_of_evidence(cell_key((0, 0, 0)), evidence, geometry, SensorModel(), occupied_only=True)


def panels_of(path: Path, voxels: Voxels) -> list[npt.NDArray[np.uint8]]:
    """The picture's views, with titles and legends, BGR."""
    write_map_picture(path, voxels, voxel_edge_m=0.05)
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape[1] % PANEL_PX[0] == 0
    return [np.asarray(part, np.uint8) for part in np.split(image, image.shape[1] // PANEL_PX[0], axis=1)]


def view_of(panel: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    return panel[TITLE_PX : TITLE_PX + PANEL_PX[1]]


@pytest.mark.parametrize(
    ("voxels", "count"),
    [
        (wall(PLAIN), 2),
        (wall(), 2),
        (wall(shade=90), 2),
        (wall(kelvin=[300.0]), 3),
        (wall(shade=90, kelvin=[300.0]), 3),
    ],
    ids=["no channels", "nothing measured", "colour", "temperature", "both"],
)
def test_only_what_was_measured_has_a_view(voxels: Voxels, count: int, tmp_path: Path) -> None:
    assert len(panels_of(tmp_path / "map.png", voxels)) == count


def test_a_map_fills_its_view(tmp_path: Path) -> None:
    for panel in panels_of(tmp_path / "map.png", wall(shade=200)):
        drawn = (view_of(panel) != BACKGROUND[::-1]).any(axis=2)
        rows, columns = np.nonzero(drawn.any(axis=1))[0], np.nonzero(drawn.any(axis=0))[0]
        margins = (rows[0], PANEL_PX[1] - 1 - rows[-1], columns[0], PANEL_PX[0] - 1 - columns[-1])
        assert min(margins) >= MARGIN_PX - 2
        assert max(margins[:2]) <= MARGIN_PX + 2 or max(margins[2:]) <= MARGIN_PX + 2


def test_without_colour_a_map_is_painted_by_height(tmp_path: Path) -> None:
    grey, height = (panels_of(tmp_path / "map.png", wall(shade=shade))[0] for shade in (90, None))
    shades = [{tuple(pixel) for pixel in view_of(panel).reshape(-1, 3).tolist()} for panel in (grey, height)]
    assert len(shades[0]) <= 4 < 8 < len(shades[1])


def test_a_scale_that_ends_below_the_hottest_has_a_mark(tmp_path: Path) -> None:
    even, peak = [300.0 + n / 100 for n in range(100)], [300.0] * 99 + [400.0]
    for kelvin, is_marked in ((even, False), (peak, True)):
        thermal = panels_of(tmp_path / "map.png", wall(kelvin=kelvin))[1]
        bar = thermal[TITLE_PX + PANEL_PX[1] :][:LEGEND_PX]
        beyond = bar[4:23, PANEL_PX[0] - MARGIN_PX + 1 :]
        assert (beyond != BACKGROUND[::-1]).any() == is_marked
