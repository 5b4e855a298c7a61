"""Table of black bodies for the calibration of a thermal camera, without images that a flat-field correction spoils.

    image, celsius, sigma_k [, x, y, width, height] [, housing_celsius] [, since_ffc_s]

Every few minutes such a camera closes a shutter and levels its pixels (a flat-field correction). Meanwhile it repeats
its last image, and for a moment after it the shutter's warmth is still in the picture. Images that the table or a
repetition shows to be such are left out, with a line that says so.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.image_files import read_grey
from cairn_calib.rig.radiometry import ZERO_C_K
from cairn_map.errors import BadInputError

COLUMNS = ["image", "celsius", "sigma_k"]
REGION = ["x", "y", "width", "height"]
HOUSING, SINCE_FFC = "housing_celsius", "since_ffc_s"
FFC_SETTLE_S = 2.0
"""Seconds after a flat-field correction: a shutter opens within half a second, and cameras average the next frames."""
Counts = npt.NDArray[np.float32]
Region = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class BlackBody:
    """Images of one black body at one temperature."""

    celsius: float
    sigma_k: float
    region: Region | None
    """x, y, width, height of the part of the image that it fills, pixels; None: all of it."""
    housing_k: float | None
    """Temperature of the camera itself, kelvin; None where unknown."""
    counts: Counts
    """(K, H, W)"""


@dataclass(frozen=True, slots=True)
class ReferenceTable:
    """Black bodies of a table, and the images that were left out."""

    bodies: tuple[BlackBody, ...]
    left_out: tuple[str, ...]
    """A line for each image: its name and the reason."""


@dataclass(frozen=True, slots=True)
class _Line:
    image: Path
    celsius: float
    sigma_k: float
    region: Region | None
    housing_celsius: float | None
    since_ffc_s: float | None

    @property
    def group(self) -> tuple[object, ...]:
        """Key of one black body's lines: temperature, region, and the camera's own temperature to a kelvin."""
        warm = None if self.housing_celsius is None else round(self.housing_celsius)
        return self.celsius, self.sigma_k, self.region, warm


def read_references(table: Path) -> ReferenceTable:
    """The black bodies of a table.

    Raises:
        BadInputError: it cannot be read, a column or number is missing, or images of a body differ in size.
    """
    groups: dict[tuple[object, ...], list[tuple[_Line, Counts]]] = {}
    seen: dict[bytes, str] = {}
    left_out = []
    for line in _lines(table):
        # Spoilt by the table's own statement, before any image is read.
        if line.since_ffc_s is not None and line.since_ffc_s < FFC_SETTLE_S:
            when = f"{line.since_ffc_s:g} s after" if line.since_ffc_s > 0 else "during"
            left_out.append(f"{line.image.name}: {when} a flat-field correction")
            continue
        # A repeated image has the same counts to the last bit.
        counts = read_grey(line.image)[0]
        if (twin := seen.setdefault(counts.tobytes(), line.image.name)) != line.image.name:
            left_out.append(f"{line.image.name}: {repetition_text(twin)}")
            continue
        groups.setdefault(line.group, []).append((line, counts))
    return ReferenceTable(tuple(_body(table, rows) for rows in groups.values()), tuple(left_out))


def repetition_text(twin: str) -> str:
    """Reason against an image with the same counts as another one, which noise makes impossible."""
    return f"the same counts as {twin}, as a camera repeats its last image during a flat-field correction"


def _body(table: Path, rows: list[tuple[_Line, Counts]]) -> BlackBody:
    first = rows[0][0]
    if len({counts.shape for _, counts in rows}) > 1:
        raise BadInputError("bad_references", f"{table}: the images at {first.celsius:g} C are of several sizes")
    warm = [line.housing_celsius for line, _ in rows if line.housing_celsius is not None]
    housing_k = float(np.mean(warm)) + ZERO_C_K if warm else None
    return BlackBody(first.celsius, first.sigma_k, first.region, housing_k, np.array([counts for _, counts in rows]))


def _lines(table: Path) -> list[_Line]:
    try:
        with table.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            rows = list(reader)
    except (OSError, UnicodeDecodeError) as exc:
        raise BadInputError("bad_references", f"cannot read {table}: {exc}") from exc
    if missing := [name for name in COLUMNS if name not in (reader.fieldnames or ())]:
        raise BadInputError("bad_references", f"{table} has no column {missing[0]}; its head line must name {COLUMNS}")
    lines = []
    # Line 1 is the head.
    for number, row in enumerate(rows, start=2):
        try:
            lines.append(
                _Line(
                    table.parent / row["image"],
                    float(row["celsius"]),
                    float(row["sigma_k"]),
                    _region(row),
                    _number(row, HOUSING),
                    _number(row, SINCE_FFC),
                )
            )
        except (TypeError, ValueError) as exc:
            raise BadInputError("bad_references", f"{table}, line {number}: {exc}") from exc
    return lines


def _region(row: Mapping[str, str]) -> Region | None:
    sides = [row.get(name) or "" for name in REGION]
    if not any(sides):
        return None
    x, y, width, height = (int(side) for side in sides)
    return x, y, width, height


def _number(row: Mapping[str, str], name: str) -> float | None:
    text = row.get(name) or ""
    return float(text) if text.strip() else None
