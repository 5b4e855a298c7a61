"""The ways to write a cell that the experiment compares. One more is one more entry of `CODINGS`."""

from collections.abc import Callable
from dataclasses import dataclass

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.codec.view_code import decode_view, encode_view
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import FULL_STYLE, Colours, ViewStyle
from cairn_sim.experiment.pointer_octree import decode_pointer_octree, encode_pointer_octree, occupied_voxels

Encode = Callable[[CellKey, Evidence, Geometry, SensorModel], bytes]


@dataclass(frozen=True, slots=True, kw_only=True)
class Coding:
    """One way."""

    name: str
    """Short: it heads a column and keys `report.json`."""
    holds: str
    """Content that can be read back from the bytes."""
    encode: Encode
    """Packed evidence to bytes."""
    decode: Callable[[bytes], object]
    """Bytes to what they hold; `Evidence` where that is all."""


def _fast(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> bytes:
    return encode_cell(key, evidence, geometry, profile=Profile.FAST).data


def _small(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> bytes:
    return encode_cell(key, evidence, geometry, profile=Profile.SMALL).data


def _decoded_exact(data: bytes) -> Evidence:
    return decode_cell(data).evidence


def _view(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> bytes:
    return encode_view(key, evidence, geometry, model)


def _full_view(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> bytes:
    return encode_view(key, evidence, geometry, model, style=FULL_STYLE)


def _coarse_view(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> bytes:
    return encode_view(key, evidence, geometry, model, style=ViewStyle(colours=Colours.RGB_565))


def _pointer_octree(key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel) -> bytes:
    return encode_pointer_octree(occupied_voxels(key, evidence, geometry, model))


EXACT_FAST = Coding(
    name="cairn, exact, fast",
    holds="all evidence, exactly: hits and misses of every voxel that was seen, free ones too; sums of colour, "
    "intensity, temperature and its square, and their weights. It can be added to, and retracted from.",
    encode=_fast,
    decode=_decoded_exact,
)
"""Codings of a map's folder."""
EXACT_SMALL = Coding(
    name="cairn, exact, small",
    holds="the same, with the same digest, in fewer bytes and more time.",
    encode=_small,
    decode=_decoded_exact,
)
FULL_VIEW = Coding(
    name="cairn, view, full",
    holds="the paper's fields of occupied voxels in full: log-odds in 0.001, 8-8-8 bits of colour, 0.01 K. "
    "To be looked at, never merged.",
    encode=_full_view,
    decode=decode_view,
)
VIEW = Coding(
    name="cairn, view",
    holds="the same voxels for eyes: probability in 1/255, 8-8-8 bits of colour, temperature in 0.1 K.",
    encode=_view,
    decode=decode_view,
)
COARSE_VIEW = Coding(
    name="cairn, view, 5-6-5",
    holds="the same with 5, 6 and 5 bits of red, green and blue.",
    encode=_coarse_view,
    decode=decode_view,
)
POINTER_OCTREE = Coding(
    name="pointer octree, zip",
    holds="the paper's method: of occupied voxels the log-odds, one colour and one temperature (8 B), under zip. "
    "Free and unknown are one; nothing can be added or taken out.",
    encode=_pointer_octree,
    decode=decode_pointer_octree,
)
CODINGS: tuple[Coding, ...] = (EXACT_FAST, EXACT_SMALL, FULL_VIEW, VIEW, COARSE_VIEW, POINTER_OCTREE)
