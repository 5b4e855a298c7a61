"""The pixels of ROS image messages, raw or compressed, as arrays.

    depth        16UC1 mono16 32FC1        and compressedDepth (image_transport) of 16UC1 and 32FC1
    amplitude    16UC1 mono16 8UC1 mono8
    thermal      16UC1 mono16
    colour       rgb8 bgr8 rgba8 bgra8 8UC3 mono8, JPEG, PNG
    labels       8UC1 mono8 16UC1 mono16 32SC1, PNG

Names of encodings are those of sensor_msgs/image_encodings.hpp. For compressed images the file's own header counts, and
is checked before a pixel is allocated (`recording.images`).
"""

import struct

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.raster import MAX_SIDE_PX
from cairn_fusion.recording.images import PNG_SIGNATURE, colour_of_bytes, grey16_of_bytes, labels_of_bytes
from cairn_fusion.recording.scan import LABEL_MAX
from cairn_fusion.ros.messages import RosCompressedImage, RosImage
from cairn_map.errors import BadInputError, DamagedDataError

Pixels = npt.NDArray[np.generic]
AnyImage = RosImage | RosCompressedImage

RAW = {
    "16UC1": ("u2", 1),
    "mono16": ("u2", 1),
    "32FC1": ("f4", 1),
    "32SC1": ("i4", 1),
    "8UC1": ("u1", 1),
    "mono8": ("u1", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "8UC3": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
}
"""Type and channels of a pixel, by encoding."""
DEPTHS = ("16UC1", "mono16", "32FC1")
AMPLITUDES = ("16UC1", "mono16", "8UC1", "mono8")
THERMALS = ("16UC1", "mono16")
LABELS = ("8UC1", "mono8", "16UC1", "mono16", "32SC1")
COLOURS = ("rgb8", "bgr8", "8UC3", "rgba8", "bgra8", "mono8")
BLUE_FIRST = frozenset(["bgr8", "bgra8", "8UC3"])
DEPTH_HEAD = struct.Struct("<iff")
"""Head of a compressedDepth message: format, and the two numbers of its inverse depth."""


def encoding_of(image: AnyImage) -> str:
    """Encoding of the pixels, as text for messages."""
    return image.encoding if isinstance(image, RosImage) else image.format or "compressed"


def depth_of(image: AnyImage, name: str) -> Pixels:
    """(H, W) uint16 counts, or float32 metres; 0 and NaN where nothing came back.

    Args:
        image: the message.
        name: name of the image in errors.

    Raises:
        BadInputError: the encoding holds no depth.
        DamagedDataError: fewer bytes than pixels, or a file that cannot be decoded.
    """
    if isinstance(image, RosImage):
        return _raw(image, DEPTHS, name)
    if "compressedDepth" not in image.format:
        return grey16_of_bytes(bytes(image.data), name)
    file = bytes(image.data[DEPTH_HEAD.size :])
    if not file.startswith(PNG_SIGNATURE):
        raise BadInputError(
            "unknown_encoding", f"{name} is {image.format!r}; of compressedDepth only PNG is read: republish it as raw"
        )
    counts = grey16_of_bytes(file, name)
    if not image.format.startswith("32FC1"):
        return counts
    _, a, b = DEPTH_HEAD.unpack_from(image.data)
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.where(counts > 0, a / (counts.astype(np.float64) - b), np.nan)
    return metres.astype(np.float32)


def amplitude_of(image: AnyImage, name: str) -> npt.NDArray[np.uint16]:
    """(H, W) uint16; 8 bits are taken as they are. Errors as `depth_of`."""
    if isinstance(image, RosImage):
        return _raw(image, AMPLITUDES, name).astype(np.uint16)
    return grey16_of_bytes(bytes(image.data), name)


def thermal_counts_of(image: AnyImage, name: str) -> npt.NDArray[np.uint16]:
    """(H, W) uint16 counts. Errors as `depth_of`."""
    if isinstance(image, RosImage):
        return _raw(image, THERMALS, name).astype(np.uint16)
    return grey16_of_bytes(bytes(image.data), name)


def labels_of(image: AnyImage, name: str) -> npt.NDArray[np.uint8 | np.uint16]:
    """(H, W) uint8 or uint16 numbers of labels. Errors as `depth_of`.

    Raises:
        BadInputError: also kind `unknown_label`: one of 32 bits is below 0 or above 65535.
    """
    if not isinstance(image, RosImage):
        return labels_of_bytes(bytes(image.data), name)
    numbers = _raw(image, LABELS, name)
    if numbers.dtype == np.uint8:
        return numbers.astype(np.uint8, copy=False)
    wide = numbers.astype(np.int32)
    strange = wide[(wide < 0) | (wide > LABEL_MAX)]
    if len(strange):
        raise BadInputError("unknown_label", f"{name} holds {strange[0]}; labels are numbers from 0 to {LABEL_MAX}")
    return wide.astype(np.uint16)


def colour_of(image: AnyImage, name: str) -> npt.NDArray[np.uint8]:
    """(H, W, 3) uint8 sRGB, R, G, B order. Errors as `depth_of`."""
    if not isinstance(image, RosImage):
        return colour_of_bytes(bytes(image.data), name)
    pixels = _raw(image, COLOURS, name)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    rgb = pixels[..., 2::-1] if image.encoding in BLUE_FIRST else pixels[..., :3]
    return np.ascontiguousarray(rgb, dtype=np.uint8)


def _raw(image: RosImage, allowed: tuple[str, ...], name: str) -> Pixels:
    """(H, W) or (H, W, C) pixels of a raw image's bytes, without the padding at the end of rows."""
    if image.encoding not in allowed:
        raise BadInputError(
            "unknown_encoding",
            f"{name} has encoding {image.encoding[:40]!r}; read are {', '.join(allowed)}: republish it as one "
            "of them, or choose another topic",
        )
    letter, channels = RAW[image.encoding]
    dtype = np.dtype(letter).newbyteorder(">" if image.is_big_endian else "<")
    row_bytes = image.width * channels * dtype.itemsize
    if not 0 < image.width <= MAX_SIDE_PX or not 0 < image.height <= MAX_SIDE_PX:
        raise DamagedDataError("bad_image", f"{name} is {image.width} x {image.height}, at most {MAX_SIDE_PX} a side")
    if image.step < row_bytes or image.step * image.height > len(image.data):
        raise DamagedDataError(
            "bad_image",
            f"{name} is {image.width} x {image.height} {image.encoding} in rows of {image.step} bytes, but has "
            f"{len(image.data)} bytes",
        )
    rows = np.frombuffer(image.data, np.uint8, count=image.step * image.height).reshape(image.height, image.step)
    pixels = np.ascontiguousarray(rows[:, :row_bytes]).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(image.height, image.width, channels)
