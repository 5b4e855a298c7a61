"""What a pixel must show: the first of the server's voxels that its ray meets, found by looking at all of them."""

import io
from dataclasses import dataclass

import httpx
import numpy as np
import numpy.typing as npt
from tests.console.conftest import ADMIN_TOKEN, Room
from tests.console.room import GEOMETRY, MAP

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Occupied:
    """The map's occupied voxels, from the server's own NPZ files."""

    numbers: npt.NDArray[np.int64]
    """(V, 3) on the lattice."""
    counts: npt.NDArray[np.int64]
    """(V, 2) hits and misses."""
    probability: Floats
    temperature_k: Floats
    """NaN: none."""
    rgb: Floats
    """(V, 3); NaN: none."""


def occupied(room: Room) -> Occupied:
    headers = {"Authorization": f"Bearer {ADMIN_TOKEN}"}
    parts = []
    with httpx.Client(base_url=room.url, headers=headers, timeout=60) as http:
        for entry in http.get(f"/maps/{MAP}/main/cells").json()["cells"]:
            cell = ",".join(map(str, entry["cell"]))
            with np.load(io.BytesIO(http.get(f"/maps/{MAP}/main/cells/{cell}.npz").content)) as arrays:
                keep = arrays["probability"] > 0.5
                names = ("numbers", "counts", "probability", "temperature_mean", "colour_mean")
                parts.append([arrays[name][keep] for name in names])
    return Occupied(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def first_met(boxes: Floats, edge_m: float, eye: Floats, ray: Floats) -> tuple[int | None, float]:
    """The box (V, 3 lower corners) that a ray meets first, and how much nearer it is than the next, in ray lengths."""
    with np.errstate(divide="ignore"):
        a, b = (boxes - eye) / ray, (boxes + edge_m - eye) / ray
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    met = np.nonzero((enter <= leave) & (enter > 0))[0]
    if not len(met):
        return None, np.inf
    order = met[np.argsort(enter[met])]
    gap = enter[order[1]] - enter[order[0]] if len(order) > 1 else np.inf
    return int(order[0]), float(gap)


def lattice_corners(numbers: npt.NDArray[np.int64]) -> Floats:
    return numbers * GEOMETRY.voxel_edge_m
