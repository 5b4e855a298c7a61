"""OctoMap beside us: Debian's `liboctomap-dev`, driven by a small program that is compiled when the benchmark runs."""

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.rig.poses import transform_points
from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import points_from_range

DRIVER = "octomap_driver"
QUERIES = "octomap_queries"
PROBES = "octomap_probes"
"""Names of the programs, and of their sources in this folder."""
HEADER = Path("/usr/include/octomap/octomap.h")
RANGE_MAX_M = 10.0


@dataclass(frozen=True, slots=True)
class OctomapRun:
    """What inserting took, and the leaves of the pruned tree."""

    cpu_s: float
    leaves: int


@dataclass(frozen=True, slots=True)
class OctomapAnswers:
    """The fewest CPU seconds that points and rays took, and what they found."""

    points_s: float
    known: int
    occupied: int
    rays_s: float
    hits: int


def missing() -> str:
    """Why OctoMap cannot be measured here; empty if it can."""
    if shutil.which("g++") is None:
        return "no g++ (apt-get install g++)"
    return "" if HEADER.exists() else "no OctoMap (apt-get install liboctomap-dev)"


def compiled_driver(folder: Path, name: str = DRIVER) -> Path:
    """One of the programs, compiled for this machine."""
    driver, source = folder / name, Path(__file__).with_name(f"{name}.cpp")
    options = ["-O3", "-march=native", "-DNDEBUG", "-o", str(driver)]
    subprocess.run(["g++", *options, str(source), "-loctomap", "-loctomath"], check=True)
    return driver


def write_scans(path: Path, scans: Sequence[Scan], rig: Rig) -> int:
    """The points of range images within 10 m, map frame, as the driver reads them; returns how many there are."""
    total = 0
    with path.open("wb") as file:
        for scan in scans:
            mounted = rig[scan.range_camera]
            T_map_camera = scan.T_map_rig @ mounted.transform
            seen = np.nan_to_num(scan.range_m, nan=np.inf) <= RANGE_MAX_M
            points = transform_points(T_map_camera, points_from_range(scan.range_m, mounted.camera)[seen])
            file.write(T_map_camera[:3, 3].astype("<f4").tobytes() + np.int32(len(points)).tobytes())
            file.write(points.astype("<f4").tobytes())
            total += len(points)
    return total


def write_colours(path: Path, centres_m: npt.NDArray[np.float64], colours: npt.NDArray[np.uint8]) -> None:
    """(N, 3) centres of voxels and their (N, 3) colours, as the driver reads them."""
    rows = np.zeros(len(centres_m), np.dtype([("xyz", "<f4", 3), ("rgba", np.uint8, 4)]))
    rows["xyz"] = centres_m
    rows["rgba"][:, :3] = colours
    path.write_bytes(rows.tobytes())


def insert_scans(driver: Path, scans: Path, *, voxel_edge_m: float) -> OctomapRun:
    """Occupancy alone, into an `OcTree`."""
    return _run([str(driver), str(scans), str(voxel_edge_m), str(RANGE_MAX_M)])


def voxel_states(driver: Path, scans: Path, out: Path, *, voxel_edge_m: float) -> npt.NDArray[np.int32]:
    """(N, 4) numbers of the voxels that an `OcTree` of the scans knows, and 1 for occupied or -1 for free."""
    _run([str(driver), str(scans), str(voxel_edge_m), str(RANGE_MAX_M), str(out)])
    return np.fromfile(out, "<i4").reshape(-1, 4)


def states_after_each(
    driver: Path, scans: Path, folder: Path, places_m: npt.NDArray[np.float64], *, voxel_edge_m: float
) -> npt.NDArray[np.int8]:
    """(scans, N) 1 occupied, 0 unknown, -1 free: what an `OcTree` says of (N, 3) places after each of the scans."""
    (folder / "probes").write_bytes(places_m.astype("<f4").tobytes())
    files = [str(folder / name) for name in ("probes", "probed")]
    subprocess.run([str(driver), str(scans), str(voxel_edge_m), str(RANGE_MAX_M), *files], check=True)
    return np.fromfile(folder / "probed", np.int8).reshape(-1, len(places_m))


def colour_tree(driver: Path, scans: Path, colours: Path, out: Path, *, voxel_edge_m: float) -> OctomapRun:
    """The same as a `ColorOcTree` with these colours, written to `out` (.ot)."""
    return _run([str(driver), str(scans), str(voxel_edge_m), str(RANGE_MAX_M), str(colours), str(out)])


def write_queries(
    folder: Path,
    centres_m: npt.NDArray[np.float64],
    log_odds: npt.NDArray[np.float64],
    points_m: npt.NDArray[np.float64],
    rays: npt.NDArray[np.float64],
) -> None:
    """A map's known voxels, points and (N, 6) rays, as `ask` reads them."""
    for name, rows in (("voxels", np.column_stack([centres_m, log_odds])), ("points", points_m), ("rays", rays)):
        (folder / name).write_bytes(rows.astype("<f4").tobytes())


def ask(queries: Path, folder: Path, *, voxel_edge_m: float, range_max_m: float, repeats: int) -> OctomapAnswers:
    """OctoMap's answers to what `write_queries` left in a folder, on that very map."""
    voxels, points, rays = (str(folder / name) for name in ("voxels", "points", "rays"))
    command = [str(queries), voxels, str(voxel_edge_m), points, rays, str(range_max_m), str(repeats)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return OctomapAnswers(float(said[0]), int(said[1]), int(said[2]), float(said[3]), int(said[4]))


def _run(command: list[str]) -> OctomapRun:
    cpu_s, leaves = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return OctomapRun(float(cpu_s), int(leaves))
