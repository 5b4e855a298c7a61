"""Maps as files: `cairn map get` and `cairn map export`.

A whole map is made into files here, from its cells; a part of a map is made by the server:

    $ cairn map export http://127.0.0.1:8750/maps/lab --pcd lab.pcd --box=0,0,0,8,6,3 --ceiling 2.2 --p 0.8
    lab.pcd: 1.4 MB
    $ cairn map export http://127.0.0.1:8750/maps/lab --bt lab.bt       # for planners: occupied and free space
    lab.bt: 188 kB

A storey as a ground robot sees it, for Nav2's map server; without --ground the storey with the largest free area:

    $ cairn map export http://127.0.0.1:8750/maps/lab --map-server floor1 --band 0.1,1.5
    floor1.pgm, floor1.yaml: 640 x 512 pixels of 4 cm, ground at 0.00 m, 96.1 m2 free, 12.4 m2 occupied

Of a map with layers (`cairn map layer`) --ply and --npz of the whole map have the voxels of all of them, each place in
the finest layer that shows it, with the edge of each voxel; everything else is of the map's first layer. --layer NAME,
or the layer's own URL, is one layer alone:

    $ cairn map export http://127.0.0.1:8750/maps/lab --ply fine.ply --layer fine
"""

import argparse
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlencode

import numpy as np
from pydantic import ValidationError

from cairn_client.cli.arguments import (
    Subparsers,
    add_at,
    add_map_parser,
    api_of,
    say,
    seconds_of,
    shown_bytes,
    shown_length,
)
from cairn_client.cli.floor_arguments import add_floor_arguments, asked_ground
from cairn_client.folders.map_folder import layers_of, open_layers, open_map
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import cells_with_evidence, download_cell
from cairn_client.http.map_url import layer_url
from cairn_map.codec.history_code import DecodedHistory
from cairn_map.commits.ids import map_of_layer
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.present import shown_evidence
from cairn_map.errors import BadInputError, NotFoundError, first_error
from cairn_map.evidence.grid import cell_from_text, cell_key, cell_of_key
from cairn_map.evidence.voxels import Voxels, joined_voxels, voxels_of_evidence
from cairn_map.files.cell_files import cell_file, npz_file, ply_file
from cairn_map.files.cell_folder import FolderHead, write_cell, write_head
from cairn_map.files.export_request import ExportRequest
from cairn_map.machine_memory import standard_limit_bytes
from cairn_map.progress import with_progress
from cairn_map.queries.layers.finest_voxels import joined_layers
from cairn_map.queries.layers.layered_snapshot import LayeredSnapshot
from cairn_map.render.map_server import map_files, write_map_files
from cairn_map.wire.messages import MapInfo

FORMATS = ("ply", "pcd", "laz", "npz", "ot", "bt")
ZERO_CELSIUS_K = 273.15
WHOLE_AT = "cells hold evidence of all times: --at goes with files of voxels"
VOXEL_BYTES = 300
"""Memory of a voxel on its way into a file: a row with all channels has 136, and is there twice while it is joined."""
EXPORT_BYTES_MAX = 64 << 28
"""Bytes of a file of points: those of the 2^28 voxels that a server looks at for one (PROTOCOL.md 6)."""


def add_get_parser(commands: Subparsers) -> None:
    """Add `cairn map get`."""
    get = add_map_parser(commands, "get", _get, text="download one cell")
    get.add_argument("cell", type=str.strip, help="its number, i,j,k")
    get.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=".cell, .npz, .ply or .view")
    add_at(get)


def add_export_parser(commands: Subparsers) -> None:
    """Add `cairn map export`."""
    export = add_map_parser(commands, "export", _export, text="download a whole map, or a part of it as points")
    export.add_argument("--cells", type=Path, metavar="DIR", help="one file a cell, named by its number")
    export.add_argument("--ply", type=Path, metavar="FILE", help="occupied voxels as a point cloud")
    export.add_argument("--npz", type=Path, metavar="FILE", help="all known voxels as NumPy arrays")
    export.add_argument("--picture", type=Path, metavar="FILE", help="PNG: colour, temperature, probability")
    export.add_argument(
        "--ceiling", type=float, metavar="METRES", help="leave out higher voxels; with --picture, in the picture alone"
    )
    export.add_argument(
        "--map-server", type=Path, metavar="NAME", help="a storey's floor for Nav2's map server: NAME.pgm and NAME.yaml"
    )
    add_floor_arguments(export)
    export.add_argument(
        "--layer", metavar="NAME", help="only this layer of the map (for --ply and --npz of the whole map, the finest)"
    )
    add_at(export)
    _add_part_arguments(export)


def _add_part_arguments(export: argparse.ArgumentParser) -> None:
    """Options that name a part of a map, and the kinds of file that only the server makes."""
    export.add_argument("--pcd", type=Path, metavar="FILE", help="occupied voxels for PCL and Open3D")
    export.add_argument("--laz", type=Path, metavar="FILE", help="occupied voxels for CloudCompare, PDAL, Potree, GIS")
    export.add_argument(
        "--ot", type=Path, metavar="FILE", help="OctoMap's octree of occupied and free space: log-odds, colour"
    )
    export.add_argument("--bt", type=Path, metavar="FILE", help="OctoMap's octree of occupied and free space, small")
    part = export.add_argument_group(
        "a part",
        "of the occupied space, as the console shows it: made by the server, as x, y, z, colour, p, temperature; "
        "octrees have the free space, too: of the options only --box, --floor, --ceiling and --depth cut it",
    )
    part.add_argument(
        "--box", type=str.strip, metavar="X,Y,Z,X,Y,Z", help="lowest and highest corner, metres: --box=0,0,0,8,6,3"
    )
    part.add_argument("--floor", type=float, metavar="METRES", help="leave out lower voxels")
    part.add_argument("--p", type=float, metavar="P", help="least probability of occupied nodes, 0 to 1")
    part.add_argument("--hotter", type=float, metavar="CELSIUS", help="only nodes with a voxel as hot as this")
    part.add_argument("--colder", type=float, metavar="CELSIUS", help="only nodes as cold as this in the mean")
    part.add_argument("--depth", type=int, metavar="N", help="octree depth: fewer, larger nodes (that of voxels)")
    part.add_argument(
        "--unknown",
        choices=("free", "occupied"),
        help="with --ot or --bt, take unknown space in the --box for this, as if measured once (it stays unknown)",
    )


def _get(args: argparse.Namespace) -> int:
    """Download one cell as an octree, NPZ, PLY or view, by the output's suffix."""
    api, name = api_of(args.map, args.token)
    output: Path = args.output
    suffix = output.suffix
    if suffix not in (".cell", ".npz", ".ply", ".view"):
        raise BadInputError("unknown_format", f"a cell is written as .cell, .npz, .ply or .view, got {output.name!r}")
    _check_outputs(output)
    with api:
        info = api.map_info(name)
        cell = cell_from_text(args.cell)
        body, decoded = download_cell(api, name, cell_key(cell), info.layer)
    if suffix == ".cell" and args.at is not None:
        raise BadInputError("bad_option", WHOLE_AT)
    evidence = shown_evidence(decoded.history, info.layer, info.sensor_model, at=_epoch(args, info))
    if suffix == ".cell":
        data = body
    else:
        key, model = cell_key(cell), info.sensor_model
        data, _ = cell_file(suffix[1:], key, evidence, info.geometry, model)
    output.write_bytes(data)
    say(f"cell {cell}: {len(evidence)} known voxels, {shown_bytes(len(data))} in {output}")
    return 0


def _export(args: argparse.Namespace) -> int:
    """Download all cells, and write the files that the options name."""
    if args.layer is not None:
        args.map = layer_url(args.map, args.layer)
    if args.map_server is not None:
        return _export_floor(args)
    if args.ground is not None or args.band is not None:
        raise BadInputError("bad_option", "--ground and --band are about a storey's floor: give --map-server NAME")
    if _is_part(args):
        _check_outputs(*(getattr(args, form) for form in FORMATS))
        api, name = api_of(args.map, args.token)
        with api:
            _export_part(api, name, args)
        return 0
    if not (args.cells or args.ply or args.npz or args.picture):
        raise BadInputError(
            "nothing_asked",
            "say what to write: --cells DIR, --ply FILE, --npz FILE, --picture FILE or --map-server NAME",
        )
    if args.cells and args.at is not None:
        raise BadInputError("bad_option", WHOLE_AT)
    _check_outputs(args.ply, args.npz, args.picture)
    api, name = api_of(args.map, args.token)
    with api:
        if (args.ply or args.npz) and _has_layers(api, name, args):
            _write_finest(open_layers(args.map, token=args.token.of(args.map), at_s=seconds_of(args.at)), args)
            args.ply = args.npz = None
            if not (args.cells or args.picture):
                return 0
        info = api.map_info(name)
        if args.cells:
            head = FolderHead(geometry=info.geometry, sensor_model=info.sensor_model, epoch_s=info.epoch_s)
            write_head(args.cells, head)
        voxels, count = _downloaded(api, info, args)
    if args.cells:
        say(f"{count} cells in {args.cells}/")
    if not (args.ply or args.npz or args.picture):
        return 0
    if not count:
        raise NotFoundError("empty_map", f"map {name} holds nothing yet")
    if args.npz:
        _write(args.npz, npz_file(joined_voxels(voxels.known)))
    if args.ply or args.picture:
        occupied = joined_voxels(voxels.occupied)
        if args.ply:
            _write(args.ply, ply_file(occupied))
        if args.picture:
            from cairn_fusion.view.picture import write_map_picture  # OpenCV only where a picture is asked for

            edge_m = info.geometry.voxel_edge_m
            write_map_picture(args.picture, occupied, voxel_edge_m=edge_m, ceiling_m=args.ceiling)
            say(f"{args.picture}: {len(occupied)} occupied voxels")
    return 0


def _has_layers(api: MapApi, name: str, args: argparse.Namespace) -> bool:
    """True if voxels of several layers are asked for."""
    return args.layer is None and map_of_layer(name) is None and len(layers_of(api, name)) > 1


def _write_finest(layers: LayeredSnapshot, args: argparse.Namespace) -> None:
    """Write --ply and --npz of all layers together.

    Raises:
        NotFoundError: kind `empty_map`.
    """
    for path, form in ((args.ply, "ply"), (args.npz, "npz")):
        if path is None:
            continue
        found = layers.occupied_in() if form == "ply" else layers.voxels_in()
        lengths = [len(voxels) for voxels in found.values()]
        # No occupied voxels are a file without points, no evidence is none: as of a map of one layer.
        if not sum(lengths) and (form == "npz" or not any(map(len, layers.voxels_in().values()))):
            raise NotFoundError("empty_map", f"no layer of {args.map} holds anything yet")
        edges_m = np.repeat([layers[name].geometry.voxel_edge_m for name in found], lengths)
        voxels = joined_layers(list(found.values()))
        names = np.repeat(np.array(list(found)), lengths)
        is_ply = form == "ply"
        data = ply_file(voxels, edges_m=edges_m) if is_ply else npz_file(voxels, layers=names, edges_m=edges_m)
        _write(path, data)
        say("\n".join(f"  layer {name}: {count} voxels" for name, count in zip(found, lengths, strict=True)))


def _export_floor(args: argparse.Namespace) -> int:
    """Write a storey's floor as a picture and its description.

    Raises:
        BadInputError: kind `bad_option`: there are options that are not about a floor; `bad_box`, `bad_band`.
        NotFoundError: kind `no_ground`.
    """
    others = ("cells", "picture", *FORMATS, "floor", "ceiling", "p", "hotter", "colder", "depth", "unknown")
    given = [name for name in others if getattr(args, name) is not None]
    if given:
        raise BadInputError(
            "bad_option",
            f"--{given[0]} does not go with --map-server, which takes --ground, --band, --box and --at: run the "
            "command once for each",
        )
    stem: Path = args.map_server
    picture, description = map_files(stem)
    _check_outputs(picture, description)
    box_m = None if args.box is None else np.stack(ExportRequest(box=args.box).bounds_m())
    snapshot = open_map(args.map, token=args.token.of(args.map), at_s=seconds_of(args.at))
    ground_m = asked_ground(snapshot, args)
    grid = snapshot.floor_grid(ground_m=ground_m, band_m=args.band, box_m=box_m)
    write_map_files(stem, grid)
    H, W = grid.values.shape
    say(
        f"{picture}, {description}: {W} x {H} pixels of {shown_length(grid.edge_m)}, ground at {ground_m:.2f} m, "
        f"{grid.free_m2:.1f} m2 free, {grid.occupied_m2:.1f} m2 occupied"
    )
    return 0


class _Kept(NamedTuple):
    """Voxels by cell, as far as a file of them is asked for."""

    known: list[Voxels]
    occupied: list[Voxels]


def _downloaded(api: MapApi, info: MapInfo, args: argparse.Namespace) -> tuple[_Kept, int]:
    """Voxels of all cells, and how many cells there are; each is written to `--cells` as it comes, and then let go.

    Raises:
        BadInputError: kind `too_large`: the voxels do not fit into the memory. A few bytes may stand for millions.
    """
    kept, count, size_bytes, at = _Kept([], []), 0, 0, _epoch(args, info)
    for body, cell in fetch_map(api, info):
        count += 1
        if args.cells:
            write_cell(args.cells, cell_of_key(cell.key), body)
        if args.npz:
            size_bytes += VOXEL_BYTES * sum(map(len, cell.history.rows.values()))
            _check_memory(size_bytes)
            kept.known.append(_voxels(cell, info, at, occupied_only=False))
        if args.ply or args.picture:
            kept.occupied.append(_voxels(cell, info, at, occupied_only=True))
            size_bytes += VOXEL_BYTES * len(kept.occupied[-1])
            _check_memory(size_bytes)
    return kept, count


def _epoch(args: argparse.Namespace, info: MapInfo) -> Epoch | None:
    """Last epoch that is read for `--at`; None: all are.

    Raises:
        ConflictError: kind `not_known`: the map has no epochs.
    """
    time_s = seconds_of(args.at)
    return None if time_s is None else info.layer.epoch_at(time_s)


def _check_memory(size_bytes: int) -> None:
    limit_bytes = standard_limit_bytes()
    if size_bytes > limit_bytes:
        raise BadInputError(
            "too_large",
            f"the map's voxels need more than {shown_bytes(limit_bytes)} of memory, a quarter of this machine's; "
            "ask for a part of it (--box, --depth), or for --cells, which are written one by one",
        )


def fetch_map(api: MapApi, info: MapInfo) -> Iterator[tuple[bytes, DecodedHistory]]:
    """All cells that hold evidence, each with its bytes, in order of their numbers."""
    keys = cells_with_evidence(api, info.name)
    for key in with_progress(keys, "cells", total=len(keys)):
        yield download_cell(api, info.name, key, info.layer)


def _check_outputs(*paths: Path | None) -> None:
    """Refuse files that cannot be written, before anything is downloaded.

    Raises:
        BadInputError: kind `bad_output`.
    """
    for path in paths:
        if path is not None and (path.is_dir() or not os.access(path.absolute().parent, os.W_OK)):
            raise BadInputError("bad_output", f"cannot write {path}: is {path.absolute().parent} a folder to write in?")


def _voxels(cell: DecodedHistory, info: MapInfo, at: Epoch | None, *, occupied_only: bool) -> Voxels:
    evidence = shown_evidence(cell.history, info.layer, info.sensor_model, at=at)
    return voxels_of_evidence(cell.key, evidence, info.geometry, info.sensor_model, occupied_only=occupied_only)


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    say(f"{path}: {shown_bytes(len(data))}")


def _is_part(args: argparse.Namespace) -> bool:
    """True if the server is asked for points, not for whole cells."""
    only_parts = (args.pcd, args.laz, args.ot, args.bt)
    asked = (args.box, args.floor, args.p, args.hotter, args.colder, args.depth, args.unknown)
    if any(value is not None for value in (*only_parts, *asked)):
        return True
    # With a picture the ceiling is the picture's, and files are of the whole map.
    return args.ceiling is not None and args.picture is None and (args.ply is not None or args.npz is not None)


def _export_part(api: MapApi, name: str, args: argparse.Namespace) -> None:
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
        **{"hotter_k": _kelvin(args.hotter), "colder_k": _kelvin(args.colder), "unknown": args.unknown},
        "at": None if args.at is None else repr(seconds_of(args.at)),
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
    """Part of a map as a file, written as it comes; its size in bytes.

    What was there under this name stays until the new file is whole.

    Raises:
        UnreachableError: the link broke.
        BadInputError: the server refuses the request.
    """
    query = urlencode(asked.model_dump(mode="json", exclude_none=True))
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            for data in api.stream(f"/maps/{name}/main/export?{query}", at_most_bytes=EXPORT_BYTES_MAX):
                file.write(data)
        size_bytes = part.stat().st_size
        part.replace(path)
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot write {path}: {exc.strerror}") from exc
    finally:
        part.unlink(missing_ok=True)
    return size_bytes
