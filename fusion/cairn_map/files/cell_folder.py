"""A map as a folder: `map.json` and one file for each cell, named by its number.

    lab/map.json          geometry and sensor model
    lab/0_-1_0.cell       the cell i = 0, j = -1, k = 0, as FORMAT.md describes it

`cairn map export --cells` writes such a folder and `cairn map create --from` reads it: prior data for a new map.
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cairn_map.codec.cell_reading import CELL_BYTES_MAX
from cairn_map.codec.history_code import DecodedHistory
from cairn_map.codec.layer_code import decode_canonical_layer_cell
from cairn_map.epochs.layer import EpochLength, MapLayer
from cairn_map.errors import BadInputError, DamagedDataError, first_error
from cairn_map.evidence.grid import Cell, CellKey, Geometry, cell_key
from cairn_map.evidence.inverse_sensor_model import SensorModel

MAP_FILE = "map.json"
MAP_BYTES_MAX = 1 << 20
CELL_NAME = re.compile(r"(-?[0-9]{1,7})_(-?[0-9]{1,7})_(-?[0-9]{1,7})\.cell")


class FolderHead(BaseModel):
    """Contents of `map.json`: the geometry, the length of epochs, and the sensor model of all cells."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    geometry: Geometry
    sensor_model: SensorModel = SensorModel()
    epoch_s: Annotated[EpochLength | None, Field(exclude_if=lambda value: value is None)] = None
    """Seconds; None: one sum for all times."""

    @property
    def layer(self) -> MapLayer:
        """Definition of the cells' evidence."""
        return MapLayer(geometry=self.geometry, epoch_s=self.epoch_s)


def write_head(folder: Path, head: FolderHead) -> None:
    """Begin a folder; it may exist, but not hold another map.

    Raises:
        BadInputError: kind `other_map`: the folder holds a map with another grid.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / MAP_FILE).exists() and read_head(folder).layer != head.layer:
        raise BadInputError("other_map", f"{folder} holds a map with another grid; choose another folder")
    _write(folder / MAP_FILE, head.model_dump_json(indent=1).encode())


def write_cell(folder: Path, cell: Cell, data: bytes) -> Path:
    """Write one cell's bytes; a reader sees the whole file or none."""
    path = cell_path(folder, cell)
    _write(path, data)
    return path


def cell_path(folder: Path, cell: Cell) -> Path:
    """File of a cell."""
    return folder / f"{cell.i}_{cell.j}_{cell.k}.cell"


def read_head(folder: Path) -> FolderHead:
    """Contents of a folder's `map.json`.

    Raises:
        BadInputError: it is missing or not a map's.
    """
    path = folder / MAP_FILE
    text = _read(path, MAP_BYTES_MAX, kind="no_map_folder")
    try:
        return FolderHead.model_validate_json(text)
    except ValidationError as exc:
        raise BadInputError("no_map_folder", f"{path} does not describe a map: {first_error(exc)}") from exc


def read_cells(folder: Path, layer: MapLayer) -> Iterator[DecodedHistory]:
    """The cells of a folder, each validated, in order of their numbers.

    Raises:
        DamagedDataError: a file is not the cell that its name says; the message names it.
        BadInputError: a cell of another grid, too large, or a file that cannot be read; the message names it.
    """
    for key, path in sorted(_named_cells(folder)):
        data = _read(path, CELL_BYTES_MAX, kind="bad_cell")
        try:
            decoded = decode_canonical_layer_cell(data)
        except (DamagedDataError, BadInputError) as exc:
            raise type(exc)(exc.kind, f"{path}: {exc.message}") from exc
        if decoded.key != key:
            raise DamagedDataError("bad_cell", f"{path} holds another cell than its name says")
        if decoded.layer != layer:
            raise BadInputError("other_geometry", f"{path} was made for another grid than {folder / MAP_FILE} says")
        yield decoded


def _named_cells(folder: Path) -> Iterator[tuple[CellKey, Path]]:
    """Numbers and files of a folder's cells; files with other names are no cells."""
    try:
        paths = list(folder.iterdir())
    except OSError as exc:
        raise BadInputError("no_map_folder", f"{folder} cannot be listed: {exc.strerror}") from exc
    for path in paths:
        if match := CELL_NAME.fullmatch(path.name):
            cell = Cell(*(int(part) for part in match.groups()))
            # A cell under two names, 0_0_0 and 00_0_0, would be added twice.
            if path.name != f"{cell.i}_{cell.j}_{cell.k}.cell":
                raise DamagedDataError("bad_cell", f"{path}: the file of cell {cell} has another name")
            try:
                yield cell_key(cell), path
            except BadInputError as exc:
                raise BadInputError(exc.kind, f"{path}: {exc.message}") from exc


def _read(path: Path, size_bytes_max: int, *, kind: str) -> bytes:
    """Bytes of a regular file.

    Raises:
        BadInputError: it cannot be read (`kind`), or is too large.
    """
    try:
        if not path.is_file():  # a pipe would be waited for
            raise BadInputError(kind, f"{path} is missing, or no file")
        if path.stat().st_size > size_bytes_max:
            raise BadInputError("too_large", f"{path} has more than {size_bytes_max} bytes")
        with path.open("rb") as file:
            return file.read(size_bytes_max)
    except OSError as exc:
        raise BadInputError(kind, f"{path} cannot be read: {exc.strerror}") from exc


def _write(path: Path, data: bytes) -> None:
    fresh = path.with_name(path.name + ".new")
    with fresh.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
