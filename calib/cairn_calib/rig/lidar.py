"""Spinning lidar as a camera with a cylindrical lens: one sweep is a range image, one row a beam.

        x = 0        W/4        W/2       3W/4       W - 1
        back  ...    left  ...  forward ... right ...  back         row 0: the highest beam
                                                                     ...
                                                                     row H - 1: the lowest

Columns go round once, clockwise seen from above, and are equally wide; the row of an elevation is interpolated
between the beams, which need not be equally far apart. Camera frame: x right, y down, z forward. All beams are
taken to leave from one point at one time: offsets of single lasers and the rig's motion during a turn must be
corrected before the returns are sorted into the image.
"""

from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.raster import MAX_SIDE_PX, Raster
from cairn_map.arrays import Floats

SINGLE_BEAM_DEG = 1.0
"""Height of the one row of a lidar with one beam; a spinning line scanner's divergence is less."""


class SpinningLidar(Raster, frozen=True):
    """Range camera that turns about its y axis: `width` azimuths times `height` beams."""

    model: Literal["spinning"] = "spinning"
    elevations_deg: Annotated[
        tuple[Annotated[float, Field(ge=-89, le=89, allow_inf_nan=False)], ...],
        Field(min_length=1, max_length=MAX_SIDE_PX),
    ]
    """Elevation of each row's beam above the x-z plane, from the top row down."""

    @model_validator(mode="after")
    def _one_elevation_per_row(self) -> Self:
        if len(self.elevations_deg) != self.height:
            raise ValueError(f"elevations_deg must be one per row: {self.height}, got {len(self.elevations_deg)}")
        if np.any(np.diff(self.elevations_deg) >= 0):
            raise ValueError("elevations_deg must fall from row to row: the highest beam is the top row")
        return self

    @property
    def focal_px(self) -> tuple[float, float]:
        """Pixels per radian, along a row and (on average) along a column."""
        top, *_, bottom = self._row_elevations_rad()
        return self.width / (2 * np.pi), self.height / (top - bottom)

    def project(self, points: npt.NDArray[np.floating]) -> Floats:
        """Pixels at which points of the camera frame appear.

        Args:
            points: (..., 3), metres (any scale), camera frame.

        Returns:
            (..., 2) float64 pixels (x, y), -0.5 <= x < width - 0.5; NaN for points more than half a row above the top
            beam or below the bottom one, and for the lidar's own place.
        """
        p = np.asarray(points, dtype=np.float64)
        across = np.hypot(p[..., 0], p[..., 2])
        elevation_rad = np.where((across > 0) | (p[..., 1] != 0), np.arctan2(-p[..., 1], across), np.nan)
        # np.interp wants rising nodes, elevations fall.
        y = np.interp(-elevation_rad, -self._row_elevations_rad(), self._rows(), left=np.nan, right=np.nan)
        azimuth_rad = np.arctan2(p[..., 0], p[..., 2])
        x = (azimuth_rad + np.pi) / (2 * np.pi) * self.width - 0.5
        x = np.where(x < self.width - 0.5, x, -0.5)  # straight back is both pi and -pi
        return np.stack([np.where(np.isnan(y), np.nan, x), y], axis=-1)

    def unproject(self, pixels: npt.NDArray[np.floating]) -> Floats:
        """Unit rays through pixels; the mirror of `project`.

        Args:
            pixels: (..., 2), (x, y); x goes on round beyond the image's sides.

        Returns:
            (..., 3) float64 unit vectors, camera frame; NaN more than half a row above or below the image's rows.
        """
        x, y = np.moveaxis(np.asarray(pixels, dtype=np.float64), -1, 0)
        azimuth_rad = (x + 0.5) / self.width * (2 * np.pi) - np.pi
        elevation_rad = np.interp(y, self._rows(), self._row_elevations_rad(), left=np.nan, right=np.nan)
        elevation_rad = np.where(np.isnan(x), np.nan, elevation_rad)
        across = np.cos(elevation_rad)
        return np.stack([across * np.sin(azimuth_rad), -np.sin(elevation_rad), across * np.cos(azimuth_rad)], axis=-1)

    def _rows(self) -> Floats:
        """(H + 2,) y of the image's top edge, of the rows, and of its bottom edge."""
        return np.concatenate([[-0.5], np.arange(self.height), [self.height - 0.5]])

    def _row_elevations_rad(self) -> Floats:
        """(H + 2,) elevations at `_rows`: half a row more at the top and bottom, never beyond straight up or down."""
        beams_deg = np.array(self.elevations_deg)
        steps_deg = -np.diff(beams_deg) if self.height > 1 else np.array([SINGLE_BEAM_DEG])
        top_deg = min(beams_deg[0] + steps_deg[0] / 2, 90.0)
        bottom_deg = max(beams_deg[-1] - steps_deg[-1] / 2, -90.0)
        elevations_rad: Floats = np.radians(np.concatenate([[top_deg], beams_deg, [bottom_deg]]))
        return elevations_rad


AnyCamera = Camera | FisheyeCamera | SpinningLidar
"""Any camera of a rig. All are rasters; those with a lens have derivatives, too."""
