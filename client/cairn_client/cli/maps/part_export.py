"""A part of a map as a file, made by the server: the options of `cairn map export` that say which part.

$ cairn map export http://127.0.0.1:8750/maps/lab --pcd lab.pcd --box=0,0,0,8,6,3 --ceiling 2.2 --p 0.8
lab.pcd: 1.4 MB
"""

import argparse
from pathlib import Path
from urllib.parse import urlencode

from pydantic import ValidationError

from cairn_client.cli.arguments import say, shown_bytes
from cairn_client.http.api import MapApi
from cairn_map.errors import BadInputError, first_error
from cairn_map.files.export_request import ExportRequest

FORMATS = ("ply", "pcd", "laz", "npz", "ot", "bt")
ZERO_CELSIUS_K = 273.15


def add_part_arguments(export: argparse.ArgumentParser) -> None:
    """Which part of a map, and the kinds of file that only the server makes."""
    export.add_argument("--pcd", type=Path, metavar="FILE", help="occupied voxels for PCL and Open3D")
    export.add_argument("--laz", type=Path, metavar="FILE", help="occupied voxels for CloudCompare, PDAL, Potree, GIS")
    export.add_argument("--ot", type=Path, metavar="FILE", help="OctoMap's octree with probability and colour")
    export.add_argument("--bt", type=Path, metavar="FILE", help="OctoMap's octree of occupied or not, small")
    part = export.add_argument_group(
        "a part", "of what is occupied, as the console shows it: made by the server, as x, y, z, colour, p, temperature"
    )
    part.add_argument("--box", metavar="X,Y,Z,X,Y,Z", help="lowest and highest corner, metres: --box=0,0,0,8,6,3")
    part.add_argument("--floor", type=float, metavar="METRES", help="leave out what is lower")
    part.add_argument("--p", type=float, metavar="P", help="least probability, 0 to 1")
    part.add_argument("--hotter", type=float, metavar="CELSIUS", help="only what has a voxel as hot as this")
    part.add_argument("--colder", type=float, metavar="CELSIUS", help="only what is as cold as this in the mean")
    part.add_argument("--depth", type=int, metavar="N", help="octree depth: fewer, larger nodes (that of voxels)")


def is_part(args: argparse.Namespace) -> bool:
    """Whether the server is asked for points, not for whole cells."""
    only_parts = (args.pcd, args.laz, args.ot, args.bt)
    asked = (args.box, args.floor, args.p, args.hotter, args.colder, args.depth)
    if any(value is not None for value in (*only_parts, *asked)):
        return True
    # With a picture the ceiling is the picture's, and files are of the whole map.
    return args.ceiling is not None and args.picture is None and (args.ply is not None or args.npz is not None)


def export_part(api: MapApi, name: str, args: argparse.Namespace) -> None:
    """Write the part as each of the files that are asked for.

    Raises:
        BadInputError: kind `bad_option`: a number is out of its range, or the option is not for parts.
    """
    if args.cells or args.picture:
        raise BadInputError("bad_option", "--cells and --picture are of the whole map: run the command once for each")
    if not any(getattr(args, form) for form in FORMATS):
        raise BadInputError("nothing_asked", f"say what to write: {', '.join(f'--{form} FILE' for form in FORMATS)}")
    about = {
        **{"box": args.box, "floor_m": args.floor, "ceiling_m": args.ceiling, "p": args.p or 0.0, "depth": args.depth},
        **{"hotter_k": _kelvin(args.hotter), "colder_k": _kelvin(args.colder)},
    }
    for form in FORMATS:
        path: Path | None = getattr(args, form)
        if path is not None:
            try:
                asked = ExportRequest.model_validate({"format": form, **about})
            except ValidationError as exc:
                raise BadInputError("bad_option", f"no such part: {first_error(exc)}") from exc
            asked.bounds_m()
            say(f"{path}: {shown_bytes(export_points(api, name, asked, path))}")


def _kelvin(celsius: float | None) -> float | None:
    return None if celsius is None else celsius + ZERO_CELSIUS_K


def export_points(api: MapApi, name: str, asked: ExportRequest, path: Path) -> int:
    """Occupied nodes of a map as a file, written as it comes; its size in bytes.

    What was there under this name stays until the new file is whole.

    Raises:
        UnreachableError: the link broke.
        BadInputError: the server refuses what is asked for.
    """
    query = urlencode(asked.model_dump(mode="json", exclude_none=True))
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            for data in api.stream(f"/maps/{name}/main/export?{query}"):
                file.write(data)
        size_bytes = part.stat().st_size
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return size_bytes
