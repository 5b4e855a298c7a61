r"""FLIR's radiometric JPEG files: raw counts, Planck's numbers of the camera, and the scene as its user entered it.

    JPEG APP1 segments "FLIR\0", in order  ->  one stream "FFF\0"  ->  a table of records
    record 0x01: raw counts, 16 bits, as they are or as a PNG (whose bytes FLIR writes the wrong way round)
    record 0x20: emissivity, distance, temperatures, humidity, R1, B, F, O, R2, the air's constants

After ExifTool's description of the format (Image::ExifTool::FLIR). All lengths are checked against the bytes there.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from cairn_calib.rig.image_files import read_bounded
from cairn_calib.rig.radiometry import PlanckResponse, Radiometry
from cairn_calib.thermal.object_temperature import Viewing, air_transmission
from cairn_map.arrays import Counts
from cairn_map.errors import BadInputError, DamagedDataError

Endian = Literal["<", ">"]

FILE_BYTES_MAX = 64 << 20
SIDE_MAX = 16384
RECORDS_MAX = 1000
RAW_DATA, CAMERA_INFO = 0x01, 0x20
RECORD_BYTES = 32
CAMERA_INFO_BYTES = 0x310
ACCURACY_K = 1.0
"""FLIR states 2 K or 2 % as a limit for its radiometric cameras; taken as two standard deviations."""


@dataclass(frozen=True, slots=True)
class FlirImage:
    """Counts and numbers of one FLIR file."""

    counts: Counts
    """(H, W)"""
    radiometry: Radiometry
    viewing: Viewing
    """Surface and surroundings, as the camera's user entered them."""
    model: str


def read_flir(path: Path) -> FlirImage:
    """The counts and the numbers in a FLIR radiometric JPEG.

    Raises:
        BadInputError: missing, too large, or a picture without counts: it was never radiometric, or was edited.
        DamagedDataError: it breaks off, or its numbers cannot be.
    """
    data = read_bounded(path, FILE_BYTES_MAX)
    try:
        records = _records(_stream(data))
        if RAW_DATA not in records or CAMERA_INFO not in records:
            raise BadInputError(
                "not_radiometric",
                f"{path} is not radiometric: it has no raw counts. Save it with the camera's own program as a "
                "radiometric JPEG, and do not edit it",
            )
        counts = _counts(records[RAW_DATA])
        radiometry, viewing, model = _camera_info(records[CAMERA_INFO])
    except (struct.error, ValueError, IndexError) as exc:
        raise DamagedDataError("bad_image", f"{path} is damaged: {exc}") from exc
    return FlirImage(counts, radiometry, viewing, model)


def _stream(data: bytes) -> bytes:
    """The FFF stream, put together from its segments; empty if there is none."""
    if data[:2] != b"\xff\xd8":
        raise ValueError("it is no JPEG")
    parts: dict[int, bytes] = {}
    at = 2
    while True:
        # JPEG segments up to the scan; struct raises where the file breaks off.
        prefix, marker, length = struct.unpack_from(">BBH", data, at)
        if prefix != 0xFF or length < 2:
            raise ValueError(f"a JPEG marker was expected at byte {at}")
        if marker in (0xDA, 0xD9):
            return b"".join(parts[n] for n in sorted(parts))
        body = data[at + 4 : at + 2 + length]
        # APP1 of FLIR: byte 6 counts the parts, bytes from 8 on are the stream.
        if marker == 0xE1 and body[:5] == b"FLIR\0" and len(body) > 8:
            parts[body[6]] = body[8:]
        at += 2 + length


def _records(stream: bytes) -> dict[int, bytes]:
    """The records' bytes by kind."""
    if stream[:4] != b"FFF\0":
        return {}
    # The version, about 100, shows the byte order of the table.
    endian: Endian = ">" if struct.unpack_from(">I", stream, 0x14)[0] < 1 << 16 else "<"
    start, count = struct.unpack_from(f"{endian}II", stream, 0x18)
    if count > RECORDS_MAX:
        raise ValueError(f"{count} records")
    found: dict[int, bytes] = {}
    for n in range(count):
        kind, _, _, _, offset, length = struct.unpack_from(f"{endian}HHIIII", stream, start + n * RECORD_BYTES)
        # Every record must lie in the stream; of several of one kind the first counts.
        if kind and offset + length > len(stream):
            raise ValueError(f"record {kind:#x} goes beyond the end")
        found.setdefault(kind, stream[offset : offset + length])
    return found


def _endian(record: bytes) -> Endian:
    """A record begins with the number 2 (or 3), 16 bits, in its own byte order."""
    return "<" if struct.unpack_from("<H", record)[0] < 0x100 else ">"


def _counts(record: bytes) -> Counts:
    endian = _endian(record)
    width, height = struct.unpack_from(f"{endian}HH", record, 2)
    if not (0 < width <= SIDE_MAX and 0 < height <= SIDE_MAX):
        raise ValueError(f"counts of {width} x {height} pixels")
    body = record[32:]
    if body[:4] == b"\x89PNG":
        # The PNG's own size is checked before it is decoded.
        size = struct.unpack_from(">II", body, 16)
        if size != (width, height):
            raise ValueError(f"a PNG of {size[0]} x {size[1]} pixels for {width} x {height}")
        image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint16 or image.shape != (height, width):
            raise ValueError("the PNG of its counts cannot be decoded")
        # FLIR writes little-endian counts into a big-endian format.
        return np.asarray(image, np.uint16).byteswap()
    if len(body) < 2 * width * height:
        raise ValueError("its counts break off")
    return np.frombuffer(body, f"{endian}u2", width * height).reshape(height, width).astype(np.uint16)


def _camera_info(record: bytes) -> tuple[Radiometry, Viewing, str]:
    if len(record) < CAMERA_INFO_BYTES:
        raise ValueError("the camera's numbers break off")
    endian = _endian(record)

    def floats(at: int, count: int) -> list[float]:
        return [float(v) for v in struct.unpack_from(f"{endian}{count}f", record, at)]

    # Offsets as in ExifTool's table of the record.
    emissivity, distance_m, reflected_k, air_k, window_k, window = floats(0x20, 6)
    (humidity,), (r1, b_k, f), air = floats(0x3C, 1), floats(0x58, 3), floats(0x70, 5)
    high_k, low_k = floats(0x90, 2)
    (o,), (r2,) = struct.unpack_from(f"{endian}i", record, 0x308), floats(0x30C, 1)
    model = record[0xD4:0xF4].split(b"\0")[0].decode("ascii", "replace").strip()
    numbers = (emissivity, distance_m, reflected_k, air_k, window_k, window, humidity, *air, r1, b_k, f, r2)
    if not (
        np.isfinite(numbers).all() and r2 > 0 and 0 < emissivity <= 1 and 0 < window <= 1 and 0 <= distance_m < 1e5
    ):
        raise ValueError("the camera's numbers cannot be")
    # Some cameras write per cent.
    humidity = humidity / 100 if humidity > 2 else humidity
    a1, a2, b1, b2, x = air
    response = PlanckResponse(r=r1 / r2, b_k=b_k, f=f, o=-float(o))
    radiometry = Radiometry(
        response=response,
        range_k=(low_k, high_k),
        accuracy_k=ACCURACY_K,
        source=f"numbers of its maker in a file of a FLIR {model.removeprefix('FLIR').strip('* ') or 'camera'}",
    )
    a1, a2, b1, b2, x = air
    through = air_transmission(distance_m, air_k=air_k, humidity=humidity, constants=(a1, a2, b1, b2, x))
    viewing = Viewing(
        emissivity=emissivity,
        reflected_k=reflected_k,
        transmission=through * window,
        air_k=_air_and_window(response, through, air_k, window, window_k),
    )
    return radiometry, viewing, model


def _air_and_window(response: PlanckResponse, through: float, air_k: float, window: float, window_k: float) -> float:
    """Temperature of an air alone that emits as much as air and window together, with the transmission of both."""
    own = 1 - through * window
    if own <= 0:
        return air_k
    shares = window * (1 - through) / own, (1 - window) / own
    return float(response.kelvin_of(np.dot(shares, response.counts_of([air_k, window_k]))))
