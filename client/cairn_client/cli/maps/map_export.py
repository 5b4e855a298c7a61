"""Maps as files: the `get` and `export` subcommands of `cairn map`."""

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from cairn_client.cli.arguments import api_of, say, shown_bytes, with_progress
from cairn_client.cli.maps.part_export import FORMATS, export_part, is_part
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import cells_with_evidence, download_cell
from cairn_map.codec.cell_code import DecodedCell
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.evidence.grid import cell_from_text, cell_key, cell_of_key
from cairn_map.evidence.voxels import Voxels, joined_voxels, voxels_of_evidence
from cairn_map.files.cell_files import cell_file, npz_file, ply_file
from cairn_map.files.cell_folder import FolderHead, write_cell, write_head
from cairn_map.wire.messages import MapInfo


def get_cell(args: argparse.Namespace) -> None:
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
        body, decoded = download_cell(api, name, cell)
    if suffix == ".cell":
        data = body
    else:
        key, model = cell_key(cell), info.sensor_model
        data, _ = cell_file(suffix[1:], key, decoded.evidence, info.geometry, model)
    output.write_bytes(data)
    say(f"cell {cell}: {len(decoded.evidence)} known voxels, {shown_bytes(len(data))} in {output}")


def export_map(args: argparse.Namespace) -> None:
    """Download all cells, and write what was asked for."""
    if is_part(args):
        _check_outputs(*(getattr(args, form) for form in FORMATS))
        api, name = api_of(args.map, args.token)
        with api:
            export_part(api, name, args)
        return
    if not (args.cells or args.ply or args.npz or args.picture):
        raise BadInputError("nothing_asked", "say what to write: --cells DIR, --ply FILE, --npz FILE or --picture FILE")
    _check_outputs(args.ply, args.npz, args.picture)
    api, name = api_of(args.map, args.token)
    with api:
        info = api.map_info(name)
        cells = list(fetch_map(api, name))
    if args.cells:
        write_head(args.cells, FolderHead(geometry=info.geometry, sensor_model=info.sensor_model))
        for body, cell in cells:
            write_cell(args.cells, cell_of_key(cell.key), body)
        say(f"{len(cells)} cells in {args.cells}/")
    if not (args.ply or args.npz or args.picture):
        return
    if not cells:
        raise NotFoundError("empty_map", f"map {name} holds nothing yet")
    if args.npz:
        _write(args.npz, npz_file(_all_voxels(cells, info, occupied_only=False)))
    if args.ply or args.picture:
        occupied = _all_voxels(cells, info, occupied_only=True)
        if args.ply:
            _write(args.ply, ply_file(occupied))
        if args.picture:
            from cairn_fusion.view.picture import write_map_picture  # OpenCV only where a picture is asked for

            edge_m = info.geometry.voxel_edge_m
            write_map_picture(args.picture, occupied, voxel_edge_m=edge_m, ceiling_m=args.ceiling)
            say(f"{args.picture}: {len(occupied)} occupied voxels")


def fetch_map(api: MapApi, name: str) -> Iterator[tuple[bytes, DecodedCell]]:
    """All cells that hold evidence, each with its bytes, in order of their numbers."""
    cells = cells_with_evidence(api, name)
    for cell in with_progress(cells, "cells", total=len(cells)):
        yield download_cell(api, name, cell)


def _check_outputs(*paths: Path | None) -> None:
    """Refuse files that cannot be written, before anything is downloaded.

    Raises:
        BadInputError: kind `bad_output`.
    """
    for path in paths:
        if path is not None and (path.is_dir() or not os.access(path.absolute().parent, os.W_OK)):
            raise BadInputError("bad_output", f"cannot write {path}: is {path.absolute().parent} a folder to write in?")


def _all_voxels(cells: list[tuple[bytes, DecodedCell]], info: MapInfo, *, occupied_only: bool) -> Voxels:
    return joined_voxels([_voxels(cell, info, occupied_only=occupied_only) for _, cell in cells])


def _voxels(cell: DecodedCell, info: MapInfo, *, occupied_only: bool) -> Voxels:
    return voxels_of_evidence(cell.key, cell.evidence, cell.geometry, info.sensor_model, occupied_only=occupied_only)


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    say(f"{path}: {shown_bytes(len(data))}")
