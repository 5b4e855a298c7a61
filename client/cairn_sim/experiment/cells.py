"""The finished map's cells: how full they are, how large and how fast each coding is, and their folder.

Every cell is written once in every coding and read back, in one thread; times are CPU times, so that other work on
the machine does not count. What an exact coding reads back must be what went in, or the experiment stops.
"""

import shutil
import time
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from cairn_map.errors import DamagedDataError
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.cell_folder import FolderHead, write_cell, write_head
from cairn_sim.experiment.codings import CODINGS, EXACT_FAST
from cairn_sim.experiment.figures import CellFigures, CodedCell

T = TypeVar("T")
PART = ".part"
"""Ends the name of a folder that is being written."""


def measure_cells(
    whole: EvidenceMap, folder: Path, *, model: SensorModel
) -> Generator[tuple[CellKey, Evidence, CellFigures], None, None]:
    """Each non-empty cell with its evidence and figures; when all were taken, `folder` holds the map.

    Who leaves early leaves no folder.
    """
    part = folder.with_name(folder.name + PART)
    try:
        write_head(part, FolderHead(geometry=whole.geometry, sensor_model=model))
        for number, key in enumerate(whole):
            if number == 0:
                _figures(whole, key, model)  # once for the caches, else the first cell looks slow
            evidence, figures, data = _figures(whole, key, model)
            if not len(evidence):
                continue
            write_cell(part, cell_of_key(key), data)
            yield key, evidence, figures
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _figures(whole: EvidenceMap, key: CellKey, model: SensorModel) -> tuple[Evidence, CellFigures, bytes]:
    """A cell's evidence, its figures, and its bytes as `EXACT_FAST` writes them."""
    geometry = whole.geometry
    evidence, pack_s = _timed(lambda: whole.evidence(key))
    _, unpack_s = _timed(lambda: brick_cell(geometry, [evidence]))
    coded: dict[str, CodedCell] = {}
    exact = b""
    for coding in CODINGS:
        data, encode_s = _timed(partial(coding.encode, key, evidence, geometry, model))
        decoded, decode_s = _timed(partial(coding.decode, data))
        if isinstance(decoded, Evidence) and decoded != evidence:
            raise DamagedDataError("bad_cell", f"cell {cell_of_key(key)} came back from {coding.name!r} as another")
        coded[coding.name] = CodedCell(size_bytes=len(data), encode_s=encode_s, decode_s=decode_s)
        if coding is EXACT_FAST:
            exact = data
    figures = CellFigures(
        cell=str(cell_of_key(key)),
        known=len(evidence),
        occupied=int(np.count_nonzero(model.occupied(evidence.counts))),
        pack_s=pack_s,
        unpack_s=unpack_s,
        coded=coded,
    )
    return evidence, figures, exact


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    """Result of the work, and the CPU seconds of this thread that it took."""
    start_s = time.thread_time()
    result = work()
    return result, time.thread_time() - start_s
