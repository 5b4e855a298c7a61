"""Scan as bytes that give back the same scan, bit for bit: for storage, not for exchange (see RECORDING.md).

    length of the head (u32, little-endian) | head, JSON | zstd frame of all arrays, one after the other, checksummed

Poses are among the arrays as they stand: a rotation that is made orthonormal again may change in its last bit.
"""

import json
import math
import struct
from collections.abc import Mapping
from copy import copy
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import zstandard

from cairn_calib.rig.poses import Transform, check_transform, inverse
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import DamagedDataError

LEVEL = 1
"""Level of zstd. Five noisy images, 10 MB, take 30 ms and leave 60 %; level 3 takes 90 ms for 2 % less."""
SCAN_BYTES_MAX = 1 << 30
"""Largest size of the arrays of one scan."""
HEAD = struct.Struct("<I")
Array = npt.NDArray[Any]


def encode_scan(scan: Scan) -> bytes:
    """A scan whose images have the types that `check_scan` demands, as bytes."""
    arrays = _arrays(scan)
    head = {
        "time_s": float(scan.time_s),
        "range_camera": scan.range_camera,
        "scalars": {name: float(value) for name, value in scan.scalars.items()},
        "arrays": [(*name, array.dtype.str, array.shape) for name, array in arrays.items()],
    }
    if scan.label_names:
        head["label_names"] = [(int(number), name) for number, name in scan.label_names.items()]
    text = json.dumps(head).encode()
    raw = b"".join(array.tobytes() for array in arrays.values())
    packed = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(raw)
    return HEAD.pack(len(text)) + text + packed


def decode_scan(data: bytes) -> Scan:
    """Scan in bytes; the mirror of `encode_scan`.

    Raises:
        DamagedDataError: they are not what was encoded.
    """
    try:
        (length,) = HEAD.unpack_from(data)
        head = json.loads(data[HEAD.size : HEAD.size + length])
        raw = zstandard.ZstdDecompressor().decompress(data[HEAD.size + length :], max_output_size=SCAN_BYTES_MAX)
        arrays: dict[tuple[str, str], Array] = {}
        at = 0
        for kind, name, dtype, shape in head["arrays"]:
            count = math.prod(shape)
            arrays[kind, name] = np.frombuffer(raw, dtype, count, at).reshape(shape)
            at += arrays[kind, name].nbytes
        scan = Scan(
            time_s=head["time_s"],
            T_map_rig=arrays["pose", "rig"],
            range_camera=head["range_camera"],
            range_m=arrays["range", ""],
            points_m=arrays.get(("points", "")),
            amplitude=arrays.get(("amplitude", "")),
            colour=_of_kind(arrays, "colour"),
            thermal=_of_kind(arrays, "thermal"),
            labels=_of_kind(arrays, "labels"),
            label_names={int(number): _label_name(name) for number, name in head.get("label_names", ())},
            scalars=head["scalars"],
            T_map_body=arrays.get(("pose", "body")),
        )
    except (struct.error, zstandard.ZstdError, ValueError, KeyError, TypeError) as exc:
        raise DamagedDataError("damaged_scan", f"a kept scan is damaged: {exc}") from exc
    return _with_poses(scan, arrays["pose", "rig"], arrays.get(("pose", "body")))


def read_images(file: BinaryIO) -> frozenset[tuple[str, str, str, tuple[int, ...]]]:
    """Kind, camera, type and shape of each array of the scan that begins at the file's place; images are not read.

    Points without a raster have shape (), however many there are.

    Raises:
        DamagedDataError: no scan begins there.
    """
    try:
        return frozenset(
            (str(kind), str(name), str(dtype), () if kind == "points" else tuple(shape))
            for kind, name, dtype, shape in _read_head(file)["arrays"]
        )
    except (struct.error, ValueError, KeyError, TypeError) as exc:
        raise DamagedDataError("damaged_scan", f"a kept scan is damaged: {exc}") from exc


def read_time(file: BinaryIO) -> float:
    """Time of the scan that begins at the file's place, seconds; images are not read.

    Raises:
        DamagedDataError: no scan begins there.
    """
    try:
        return float(_read_head(file)["time_s"])
    except (struct.error, ValueError, KeyError, TypeError) as exc:
        raise DamagedDataError("damaged_scan", f"a kept scan is damaged: {exc}") from exc


def _read_head(file: BinaryIO) -> Any:
    (length,) = HEAD.unpack(file.read(HEAD.size))
    return json.loads(file.read(length))


def move_scan(scan: Scan, T_map_rig: Transform) -> Scan:
    """Give a scan another pose; the robot's body moves with the rig.

    Raises:
        BadInputError: the pose is none.
    """
    return place_scan(scan, check_transform(T_map_rig, name="T_map_rig"))


def place_scan(scan: Scan, T_map_rig: Transform) -> Scan:
    """Give a scan the pose of one that was checked, bit for bit; the robot's body moves with the rig."""
    T_map_body = scan.T_map_body
    # For an unchanged pose not even the last bit of the body's pose changes.
    same_pose = np.array_equal(T_map_rig, scan.T_map_rig)
    there = T_map_body if same_pose or T_map_body is None else T_map_rig @ inverse(scan.T_map_rig) @ T_map_body
    # A copy is not checked again: both poses were, and the check takes as long as the decoding of a small scan.
    return _with_poses(copy(scan), T_map_rig, there)


def _arrays(scan: Scan) -> dict[tuple[str, str], Array]:
    """All arrays of a scan by kind and camera."""
    arrays: dict[tuple[str, str], Array] = {("pose", "rig"): scan.T_map_rig, ("range", ""): scan.range_m}
    if scan.T_map_body is not None:
        arrays["pose", "body"] = scan.T_map_body
    if scan.points_m is not None:
        arrays["points", ""] = scan.points_m
    if scan.amplitude is not None:
        arrays["amplitude", ""] = scan.amplitude
    arrays |= {("colour", name): image for name, image in scan.colour.items()}
    arrays |= {("thermal", name): image for name, image in scan.thermal.items()}
    arrays |= {("labels", name): image for name, image in scan.labels.items()}
    return arrays


def _label_name(name: object) -> str | None:
    """Class of a label; None says nothing.

    Raises:
        ValueError: it is no text.
    """
    if name is None or isinstance(name, str):
        return name
    raise ValueError(f"the name of a label is a text or null, got {name!r:.80}")


def _of_kind(arrays: Mapping[tuple[str, str], Array], kind: str) -> dict[str, Array]:
    return {name: array for (other, name), array in arrays.items() if other == kind}


def _with_poses(scan: Scan, T_map_rig: Transform, T_map_body: Transform | None) -> Scan:
    """A scan with poses as they stand: the scan's own check would make their rotations orthonormal once more."""
    object.__setattr__(scan, "T_map_rig", T_map_rig)
    object.__setattr__(scan, "T_map_body", T_map_body)
    return scan
