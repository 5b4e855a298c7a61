"""`cairn map heal`: cells that a server's disk damaged, from a folder that `cairn map export --cells` wrote."""

import argparse
from pathlib import Path

from cairn_client.cli.arguments import api_of, say, with_progress
from cairn_client.http.api import MapApi
from cairn_client.http.http_link import index_of
from cairn_map.codec.cell_code import encode_cell
from cairn_map.errors import DamagedDataError
from cairn_map.evidence.grid import Cell, cell_key
from cairn_map.files.cell_folder import read_cells, read_head


def heal(args: argparse.Namespace) -> None:
    """Look at every cell of the map, and send those that are damaged there and as they were here.

    Raises:
        DamagedDataError: kind `damaged_store`: cells are damaged there, and not here as they were.
    """
    folder: Path = args.folder
    cells = {cell.key: cell for cell in read_cells(folder, read_head(folder).geometry)}
    api, name = api_of(args.map, args.token)
    left: list[Cell] = []
    with api:
        entries = index_of(api, name).cells
        for entry in with_progress(entries, "cells", total=len(entries)):
            number, here = Cell(*entry.cell), cells.get(cell_key(entry.cell))
            if _is_sound(api, name, number, entry.digest):
                continue
            if here is None or here.digest.hex() != entry.digest:
                left.append(number)
                continue
            api.put_cell(name, number, encode_cell(here.key, here.evidence, here.geometry).data)
            say(f"cell {number} is sound again")
    if left:
        names = ", ".join(map(str, left))
        raise DamagedDataError("damaged_store", f"still damaged, and not in {folder} as they were: {names}")
    say(f"{len(entries)} cells: all sound")


def add_heal_arguments(parser: argparse.ArgumentParser) -> None:
    """Where the cells are."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="cells, as `cairn map export --cells DIR` wrote them")


def _is_sound(api: MapApi, name: str, cell: Cell, digest: str) -> bool:
    try:
        api.cell(name, cell, etag=f'"{digest}"')  # the server reads it; it comes only if it changed meanwhile
    except DamagedDataError as exc:
        if exc.kind != "damaged_store":
            raise
        return False
    return True
