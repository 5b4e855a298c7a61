"""ROS's camera_info message as `rostopic echo` and `ros2 topic echo` print it: YAML documents, one a message.

    $ ros2 topic echo --once /left/camera_info > left.yaml          # or rostopic echo -n 1
    header: {stamp: {sec: 1700000000, nanosec: 0}, frame_id: left_optical_frame}
    height: 480
    width: 640
    distortion_model: plumb_bob
    d: [...]        k: [...]        r: [...]        p: [...]        binning_x: 0 ... roi: {...}
    ---

ROS 1 writes `D, K, R, P`. A camera is named as its frame; the messages of one frame must state one lens. R and P
describe the rectified image, and the place of a camera is in another topic (tf). The size and K are of the sensor's
whole image: a message that bins its images, or cuts a region out, is refused, since its images are others.
"""

import re
from pathlib import PurePath
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_calib.exchange.camera_matrix_files import MatrixNode, lens_of_ros
from cairn_calib.exchange.placed_camera import KIND, NAME, CameraFile, PlacedCamera, validate
from cairn_calib.exchange.yaml_text import read_yaml
from cairn_calib.rig.lens import Lens
from cairn_map.errors import BadInputError

FIRST_LINES = re.compile(r"^(?:[kK]|distortion_model)\s*:", re.MULTILINE)
END = re.compile(r"^[^\n]*?---[ \t]*$", re.MULTILINE)
"""End of a message; `ros2 topic echo` prints it behind a notice of lost messages in the same line."""
LOST = "A message was lost"
MESSAGES_MAX = 1000


class _Roi(BaseModel):
    model_config = ConfigDict(extra="ignore")

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


class _Header(BaseModel):
    model_config = ConfigDict(extra="ignore")

    frame_id: str = ""


class _CameraInfoMessage(BaseModel):
    """Fields of a message with a counterpart in a rig; of either version of ROS, in small letters."""

    model_config = ConfigDict(extra="ignore")

    header: _Header = _Header()
    height: int
    width: int
    distortion_model: str
    d: Annotated[tuple[float, ...], Field(max_length=100)] = ()
    k: Annotated[tuple[float, ...], Field(min_length=9, max_length=9)]
    binning_x: int = 0
    binning_y: int = 0
    roi: _Roi = _Roi()


def is_camera_info_message(text: str) -> bool:
    """True for text with the fields of the message, not those of a calibration file."""
    return len({found[0][0].lower() for found in FIRST_LINES.finditer(text)}) == 2


def read_camera_info_messages(text: str, *, name: str) -> CameraFile:
    """The cameras of the messages in a text, by frame; the last message may be cut off.

    Raises:
        BadInputError: no whole message, or one that is not of a calibrated camera; the message names the field.
    """
    *whole, rest = END.split(text)
    messages = [part for part in whole if part.strip() and not part.lstrip().startswith(LOST)] or [rest]
    if len(messages) > MESSAGES_MAX:
        raise BadInputError(
            KIND, f"{name} has {len(messages)} messages, at most {MESSAGES_MAX} are read: one will do (--once)"
        )
    lenses: dict[str, Lens] = {}
    for number, message in enumerate(messages, 1):
        told = f"{name}: message {number}" if len(messages) > 1 else name
        document = read_yaml(message, name=told)
        # ROS 1 has D, K, R, P.
        found = validate(_CameraInfoMessage, {key.lower(): value for key, value in document.items()}, name=told)
        lens = _lens_of(found, name=told)
        frame = found.header.frame_id.strip("/").replace("/", "_")
        frame = frame if NAME.fullmatch(frame) else PurePath(name).stem
        if lenses.setdefault(frame, lens) != lens:
            raise BadInputError(
                KIND, f"{told} states another lens of {frame} than the ones before it: keep the message that is right"
            )
    cameras = tuple(PlacedCamera(frame, lens, None) for frame, lens in lenses.items())
    return CameraFile(cameras, ("r, p (of the rectified image)",))


def _lens_of(found: _CameraInfoMessage, *, name: str) -> Lens:
    if not any(found.k):
        raise BadInputError(
            KIND, f"{name}: k is zero, so the camera's driver has no calibration to publish: load one into it first"
        )
    roi = found.roi
    is_cut = roi.width not in (0, found.width) or roi.height not in (0, found.height) or roi.x_offset or roi.y_offset
    if found.binning_x > 1 or found.binning_y > 1 or is_cut:
        raise BadInputError(
            KIND,
            f"{name}: binning_x, binning_y or roi say that images are binned or cut out, and k is of the whole image: "
            "record camera_info and images without",
        )
    K, D = MatrixNode(rows=3, cols=3, data=found.k), MatrixNode(rows=1, cols=len(found.d), data=found.d)
    return lens_of_ros((found.width, found.height), K, D, model=found.distortion_model, name=name)
