"""The camera matrix and coefficients in which OpenCV and ROS write a lens: checked, and turned into a camera.

[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]     k1, k2, p1, p2[, k3[, k4, k5, k6]], or k1, k2, k3, k4 of a fisheye
"""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from cairn_calib.exchange.placed_camera import KIND, checked
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_map.errors import BadInputError

BROWN_SIZES = (0, 4, 5, 8, 12, 14)
FISHEYE_SIZE = 4
HELD = 8


class MatrixNode(BaseModel):
    """Numbers in rows, as OpenCV and ROS write them."""

    model_config = ConfigDict(extra="ignore")

    rows: Annotated[int, Field(ge=0, le=1000)]
    cols: Annotated[int, Field(ge=0, le=1000)]
    data: Annotated[tuple[float, ...], Field(max_length=10_000)] = ()

    @model_validator(mode="after")
    def _full(self) -> Self:
        if len(self.data) != self.rows * self.cols:
            raise ValueError(f"data must be {self.rows} x {self.cols} numbers, got {len(self.data)}")
        return self


def lens_of(size: tuple[int, int], K: MatrixNode, D: MatrixNode, *, fisheye: bool, name: str) -> Lens:
    """The camera of an image size, a camera matrix and coefficients.

    Raises:
        BadInputError: not 3x3, with skew, or coefficients that no lens of ours has.
    """
    if len(K.data) != 9:
        raise BadInputError(KIND, f"{name}: camera_matrix must be 3x3, got {len(K.data)} numbers")
    fx, skew, cx, zero, fy, cy, *last = K.data
    if skew or zero or last != [0.0, 0.0, 1.0]:
        raise BadInputError(
            KIND, f"{name}: camera_matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: no skew, got {skew:g}"
        )
    coefficients = D.data
    if fisheye and len(coefficients) != FISHEYE_SIZE:
        raise BadInputError(KIND, f"{name}: a fisheye has 4 distortion_coefficients, got {len(coefficients)}")
    if not fisheye and len(coefficients) not in BROWN_SIZES:
        raise BadInputError(KIND, f"{name}: distortion_coefficients must be 4, 5 or 8, got {len(coefficients)}")
    if any(coefficients[HELD:]):
        raise BadInputError(
            KIND, f"{name}: distortion_coefficients[8] on (thin prism, tilt) must be 0: rig.json has no such lens"
        )
    lens = {
        "width": size[0],
        "height": size[1],
        "focal_px": (fx, fy),
        "centre_px": (cx, cy),
        "distortion": coefficients[:HELD] or (0.0,) * 4,
    }
    return checked(FisheyeCamera if fisheye else Camera, lens, name=name)


def camera_matrix(camera: Lens) -> list[float]:
    """The nine numbers, row by row."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
