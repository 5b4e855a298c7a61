"""A cell as other files: PLY for viewers, NPZ for NumPy, a view for robots that only drive."""

import io

import numpy as np
import numpy.typing as npt

from cairn_map.arrays import Floats
from cairn_map.codec.view_code import encode_view
from cairn_map.errors import BadInputError
from cairn_map.evidence.channels import ChannelKind, class_colours
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.voxels import Voxels, voxels_of_evidence

CELL_MEDIA_TYPE = "application/vnd.cairn.cell"
MEDIA_TYPES = {
    "npz": "application/x-npz",
    "ply": "application/vnd.cairn.ply",
    "view": "application/vnd.cairn.view",
}
FORMS = "octree (no suffix), .npz, .ply or .view"
NAMED = {
    "colour": ChannelKind.COLOUR,
    "temperature": ChannelKind.TEMPERATURE,
    "intensity": ChannelKind.INTENSITY,
}
"""Channels of PLY files."""
GREY = 128
"""Red, green and blue of voxels that no colour camera saw."""


def cell_file(
    suffix: str, key: CellKey, evidence: Evidence, geometry: Geometry, model: SensorModel
) -> tuple[bytes, str]:
    """One cell as a file of the given suffix, and its media type: all known voxels in NPZ, the occupied in PLY, view.

    Raises:
        BadInputError: kind `unknown_format`.
    """
    if suffix not in MEDIA_TYPES:
        raise BadInputError("unknown_format", f"cells come as {FORMS}, not as .{suffix[:16]}")
    if suffix == "view":
        return encode_view(key, evidence, geometry, model), MEDIA_TYPES[suffix]
    voxels = voxels_of_evidence(key, evidence, geometry, model, occupied_only=suffix == "ply")
    return (ply_file(voxels) if suffix == "ply" else npz_file(voxels)), MEDIA_TYPES[suffix]


def ply_file(voxels: Voxels, *, edges_m: Floats | None = None) -> bytes:
    """Voxel centres as a binary little-endian PLY point cloud.

    Properties: x y z (float, metres, map frame), red green blue (uchar), probability (float), temperature (float,
    kelvin, NaN where no thermal camera looked), intensity (float), hits, misses (int); of a dated reading colour,
    temperature and intensity `_measured_s` (double, UTC seconds since 1970, NaN where unknown). Of a channel of classes
    `class` (short, its number, -1 without votes) and `unsure` (uchar, 1 where it leads by less than two votes); a
    comment for each class gives its number and its name.

    Args:
        voxels: the voxels.
        edges_m: (N,) their edges, metres, for the property `edge` (float) of voxels of several layers; None: without.
    """
    N = len(voxels)
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    fields += [(name, "u1") for name in ("red", "green", "blue")]
    fields += [("probability", "<f4"), ("temperature", "<f4"), ("intensity", "<f4"), ("hits", "<i4"), ("misses", "<i4")]
    named = {name: voxels.of_kind(kind) for name, kind in NAMED.items()}
    times = {f"{name}_measured_s": r.measured_s for name, r in named.items() if r and r.measured_s is not None}
    fields += [(name, "<f8") for name in times]
    classes = voxels.of_kind(ChannelKind.CLASSES)
    fields += [("class", "<i2"), ("unsure", "u1")] if classes else []
    fields += [] if edges_m is None else [("edge", "<f4")]
    table = np.zeros(N, np.dtype(fields))
    for axis, name in enumerate("xyz"):
        table[name] = voxels.centres_m[:, axis]
    rgb = colours(voxels)
    for c, name in enumerate(("red", "green", "blue")):
        table[name] = rgb[:, c]
    table["probability"] = voxels.probability
    for name in ("temperature", "intensity"):
        reading = named[name]
        table[name] = reading.mean if reading else np.nan
    table["hits"], table["misses"] = voxels.counts.T
    for name, measured_s in times.items():
        table[name] = measured_s
    if classes is not None and classes.unsure is not None:
        table["class"] = np.nan_to_num(classes.mean, nan=-1)
        table["unsure"] = classes.unsure
    if edges_m is not None:
        table["edge"] = edges_m
    words = {"<f4": "float", "<f8": "double", "u1": "uchar", "<i4": "int", "<i2": "short"}
    names = classes.channel.classes if classes else ()
    head = ["ply", "format binary_little_endian 1.0", "comment cairn; metres, map frame; kelvin"]
    head += [f"comment class {number} {name}" for number, name in enumerate(names)] + [f"element vertex {N}"]
    head += [f"property {words[code]} {name}" for name, code in fields] + ["end_header", ""]
    return "\n".join(head).encode() + table.tobytes()


def npz_file(voxels: Voxels, *, layers: npt.NDArray[np.str_] | None = None, edges_m: Floats | None = None) -> bytes:
    """Voxels as a compressed NPZ: numbers, centres_m, counts, probability, and per channel mean, weight, spread,
    and of a dated reading measured_s; of a channel of classes the mean is a number in `names`, and there is unsure.

    Args:
        voxels: the voxels.
        layers: (N,) names of their layers, in whose grids the numbers are, for the array `layer`; None: of one.
        edges_m: (N,) their edges, metres, for the array `edge_m`; None: without.
    """
    arrays: dict[str, npt.NDArray[np.generic]] = {
        "numbers": voxels.numbers,
        "centres_m": voxels.centres_m,
        "counts": voxels.counts,
        "probability": voxels.probability,
    }
    arrays |= {} if layers is None else {"layer": layers}
    arrays |= {} if edges_m is None else {"edge_m": edges_m}
    for name, reading in voxels.readings.items():
        arrays[f"{name}_mean"], arrays[f"{name}_weight"] = reading.mean, reading.weight
        if reading.spread is not None:
            arrays[f"{name}_spread"] = reading.spread
        if reading.measured_s is not None:
            arrays[f"{name}_measured_s"] = reading.measured_s
        if reading.unsure is not None:
            arrays[f"{name}_unsure"], arrays[f"{name}_names"] = reading.unsure, np.array(reading.channel.classes)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def colours(voxels: Voxels) -> npt.NDArray[np.uint8]:
    """(N, 3) uint8 sRGB; grey where no colour camera looked. Of a map without colours, but with classes, theirs."""
    reading, classes = voxels.of_kind(ChannelKind.COLOUR), voxels.of_kind(ChannelKind.CLASSES)
    rgb = np.full((len(voxels), 3), GREY, np.uint8)
    if reading is None and classes is not None:
        seen = classes.weight > 0
        rgb[seen] = class_colours(len(classes.channel.classes))[classes.mean[seen].astype(np.int64)]
    if reading is not None:
        seen = reading.weight > 0
        rgb[seen] = np.rint(np.clip(reading.mean[seen], 0, 255))
    return rgb
