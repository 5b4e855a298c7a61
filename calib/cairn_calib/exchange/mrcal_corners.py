"""mrcal's corners.vnl, which mrgingham writes: a row for each point of each image, row by row of the board.

    # filename x y level
    frame01-cam0.jpg 1385.433 1471.719 0
    frame01-cam0.jpg 1483.597 1469.825 1
    frame02-cam0.jpg - - -                     no board in this image

`level` is the decimation at which a point was found: its noise is 2^level times that of level 0. A column `weight`
instead is 1 / noise. `-`, a negative level, or a weight of 0 hide a point. Written files have weights, which
mrcal-calibrate-cameras reads with --corners-cache-has-weights.
"""

from collections.abc import Iterable

import numpy as np

from cairn_calib.board.corner_file import CornerFile
from cairn_calib.exchange.corner_list import KIND, SIGMA_PX, CornerList, ListedImage, isotropic
from cairn_map.errors import BadInputError

NEEDED = ("filename", "x", "y")
HIDDEN = "-"
LEVEL_MAX = 30.0


def read_vnl(text: str, *, name: str) -> CornerList:
    """The images of a file, in its order.

    Raises:
        BadInputError: it has no such columns, or a row is not of that form; the message names its line.
    """
    columns: list[str] | None = None
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        # `##` and `#!` are comments; the first line with a single # names the columns.
        if line.startswith("#"):
            if columns is None and not line.startswith(("##", "#!")):
                columns = line[1:].split()
            continue
        fields = line.partition("#")[0].split()
        if not fields:
            continue
        if columns is None or not set(NEEDED) <= set(columns):
            raise BadInputError(KIND, f"{name} must begin with a line `# filename x y level`, as mrgingham writes it")
        row = dict(zip(columns, fields, strict=False))
        if not set(NEEDED) <= set(row):
            raise BadInputError(KIND, f"{name}, line {number}: must have {len(columns)} fields, got {len(fields)}")
        try:
            rows.setdefault(row["filename"], []).append(_point(row))
        except ValueError as exc:
            raise BadInputError(KIND, f"{name}, line {number}: {exc}") from exc
    if not rows:
        raise BadInputError(KIND, f"{name} names no image")
    return CornerList("mrcal", tuple(_image(image, points) for image, points in rows.items()))


def write_vnl(documents: Iterable[CornerFile]) -> str:
    """A file of corner documents; images without a board, too. The mirror of `read_vnl`, but for covariances.

    Of a covariance it keeps the mean of both axes.
    """
    lines = [f"## weight 1: {SIGMA_PX:g} px, one axis", "# filename x y weight"]
    for document in documents:
        corners = document.to_corners()
        if corners is None:
            lines.append(f"{document.image} - - -")
            continue
        sigmas = np.sqrt(np.trace(corners.covariance_px2, axis1=1, axis2=2) / 2)
        for (x, y), weight in zip(corners.pixels.tolist(), (SIGMA_PX / sigmas).tolist(), strict=True):
            values = f"{x!r} {y!r} {weight!r}" if np.isfinite(x) else "- - -"
            lines.append(f"{document.image} {values}")
    return "\n".join(lines) + "\n"


def _point(row: dict[str, str]) -> tuple[float, float, float]:
    """x, y and sigma in pixels; NaN of a hidden point."""
    level, weight = row.get("level", "0"), row.get("weight", "1")
    if HIDDEN in (row["x"], row["y"], level, weight):
        return np.nan, np.nan, np.nan
    x, y, decimation, certainty = (float(text) for text in (row["x"], row["y"], level, weight))
    if not np.isfinite([x, y, decimation, certainty]).all() or decimation > LEVEL_MAX:
        raise ValueError(f"x, y, level or weight is none: {' '.join(row.values())[:80]!r}")
    if decimation < 0 or certainty <= 0:
        return np.nan, np.nan, np.nan
    return x, y, SIGMA_PX * 2.0**decimation / certainty


def _image(name: str, points: list[tuple[float, float, float]]) -> ListedImage:
    values = np.array(points)
    # A single row without a point: no board.
    if len(values) == 1 and not np.isfinite(values[0, 0]):
        values = values[:0]
    return ListedImage(name, values[:, :2], isotropic(values[:, 2]))
