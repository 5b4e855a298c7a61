"""Files of ROS's map servers (Nav2's `nav2_map_server`, ROS 1's `map_server`): a picture of a floor grid, and its YAML.

    floor1.pgm     a byte a pixel, the row of the highest y first: 0 occupied, 254 free, 205 unknown
    floor1.yaml    names the picture, its resolution, and where its lowest left corner lies in the map

Both servers read (255 - byte) / 255 as the probability that a pixel is occupied: above `occupied_thresh` it is, below
`free_thresh` it is free. 205 stands for 0.1961: above the threshold of 0.196 of ROS 1, but below the 0.25 that Nav2's
own saver writes, with which unknown space would be read as free. So 0.196 is written.
"""

import json
from pathlib import Path

import numpy as np

from cairn_map.errors import BadInputError
from cairn_map.queries.floor_grid import FREE, OCCUPIED, FloorGrid

OCCUPIED_BYTE, FREE_BYTE, UNKNOWN_BYTE = 0, 254, 205
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196


def map_files(stem: Path) -> tuple[Path, Path]:
    """Places of the picture and of its description, of a map of this name.

    Raises:
        BadInputError: kind `bad_output`: a folder is no name.
    """
    if stem.name in ("", ".."):
        raise BadInputError("bad_output", f"a map's files need a name, such as floor1; got {str(stem)!r}")
    return stem.with_name(f"{stem.name}.pgm"), stem.with_name(f"{stem.name}.yaml")


def write_map_files(stem: Path, grid: FloorGrid) -> None:
    """Write a grid as the files of a map of this name; the description last, so that it never names a part of one.

    Raises:
        BadInputError: kind `bad_output`.
    """
    picture, description = map_files(stem)
    try:
        picture.write_bytes(pgm_of(grid))
        description.write_bytes(yaml_of(grid, picture.name))
    except OSError as exc:
        raise BadInputError("bad_output", f"cannot write {exc.filename}: {exc.strerror}") from exc


def pgm_of(grid: FloorGrid) -> bytes:
    """The grid as a PGM picture, binary (P5)."""
    H, W = grid.values.shape
    shades = np.full((H, W), UNKNOWN_BYTE, np.uint8)
    shades[grid.values == OCCUPIED] = OCCUPIED_BYTE
    shades[grid.values == FREE] = FREE_BYTE
    return b"P5\n%d %d\n255\n" % (W, H) + shades[::-1].tobytes()


def yaml_of(grid: FloorGrid, picture: str) -> bytes:
    """The description of a picture, named from the description's own folder."""
    x_m, y_m = grid.origin_m
    lines = (
        f"image: {json.dumps(picture)}",
        "mode: trinary",
        f"resolution: {grid.edge_m!r}",
        f"origin: [{x_m!r}, {y_m!r}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    )
    return "".join(f"{line}\n" for line in lines).encode()
