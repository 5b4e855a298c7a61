"""Corners as a table: CSV with a head line, from and for any other program.

    image,column,row,x,y,sigma                        or  image,column,row,x,y,xx,xy,yy
    left01.png,0,0,412.25,96.5,0.05                       covariance, pixels squared

Pixels are as everywhere here: the centre of the top-left pixel is (0, 0); subtract 1 from MATLAB's. `column` and `row`
count the board's points from 0, and rows of the table may come in any order and be missing where a point is hidden.
`sigma`, pixels of one axis, or `xx`, `xy`, `yy`, may be left out.

Points with names of their own (pins, lamps, heated dots on a board), wherever they are: two tables.

    point,x_m,y_m                 of the board, x to the right, y down, metres, from anywhere
    upper left,0.0,0.0
    image,point,x,y,sigma         of the images
    left01.png,upper left,412.25,96.5,0.1
"""

import csv
import io
from collections.abc import Iterable, Iterator

import numpy as np

from cairn_calib.board.board import Board
from cairn_calib.board.corner_file import CornerFile
from cairn_calib.exchange.corner_list import KIND, SIGMA_PX, CornerList, ListedImage
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

NEEDED = ("image", "column", "row", "x", "y")
NAMED_NEEDED = ("image", "point", "x", "y")
PLACES_NEEDED = ("point", "x_m", "y_m")
SPREAD = ("xx", "xy", "yy")


def read_table(text: str, *, board_size: tuple[int, int] | None, name: str) -> CornerList:
    """The images of a table, in its order.

    Args:
        text: of the file.
        board_size: columns and rows; None: as many as the table names.
        name: of the file, for messages.

    Raises:
        BadInputError: a column is missing, or a row is not of that form; the message names its line.
    """
    points: dict[str, dict[tuple[int, int], tuple[float, ...]]] = {}
    for row, where in _rows(text, NEEDED, name):
        try:
            at = (int(row["column"]), int(row["row"]))
        except (TypeError, ValueError) as exc:
            raise BadInputError(KIND, f"{where}: {exc}") from exc
        if min(at) < 0 or max(at) >= 64:
            raise BadInputError(KIND, f"{where}: column and row are 0 to 63, got {at[0]}, {at[1]}")
        _hold(points, row, at, where)
    if not points:
        raise BadInputError(KIND, f"{name} has no points")
    places = [at for held in points.values() for at in held]
    named = (1 + max(column for column, _ in places), 1 + max(row for _, row in places))
    columns, rows = board_size or named
    if named[0] > columns or named[1] > rows:
        raise BadInputError(KIND, f"{name} names points of a board of {named[0]}x{named[1]}, not of {columns}x{rows}")
    images = tuple(_image(image, held, columns, rows) for image, held in points.items())
    return CornerList("the table", images, board_size=(columns, rows))


def read_named_table(text: str, *, board: Board, name: str) -> CornerList:
    """The images of a table of named points, in its order.

    Raises:
        BadInputError: a column is missing, the board has no such point, or a row is not of that form.
    """
    known = {each.name: n for n, each in enumerate(board.named or ())}
    points: dict[str, dict[tuple[int, int], tuple[float, ...]]] = {}
    for row, where in _rows(text, NAMED_NEEDED, name):
        point = str(row["point"]).strip()
        if point not in known:
            raise BadInputError(
                KIND, f"{where}: the board has no point {point[:64]!r}; it has {', '.join(known)[:200]}"
            )
        _hold(points, row, (known[point], 0), where)
    if not points:
        raise BadInputError(KIND, f"{name} has no points")
    images = tuple(_image(image, held, len(known), 1) for image, held in points.items())
    return CornerList("the table", images, board_size=(len(known), 1))


def read_named_places(text: str, *, name: str) -> dict[str, tuple[float, float]]:
    """Places of a board's points by name, metres.

    Raises:
        BadInputError: a column is missing, a point comes twice, or a number is none.
    """
    places: dict[str, tuple[float, float]] = {}
    for row, where in _rows(text, PLACES_NEEDED, name):
        point = str(row["point"]).strip()
        if point in places:
            raise BadInputError(KIND, f"{where}: point {point[:64]!r} comes twice")
        try:
            places[point] = (float(row["x_m"]), float(row["y_m"]))
        except (TypeError, ValueError) as exc:
            raise BadInputError(KIND, f"{where}: {exc}") from exc
    return places


def _rows(text: str, needed: tuple[str, ...], name: str) -> Iterator[tuple[dict[str, str], str]]:
    """Rows by column, each with its place for messages."""
    reader = csv.DictReader(io.StringIO(text.removeprefix("\ufeff")))
    head = reader.fieldnames or ()
    if missing := [column for column in needed if column not in head]:
        raise BadInputError(KIND, f"{name}: the head line must name {', '.join(needed)}; {missing[0]} is missing")
    for row in reader:
        yield row, f"{name}, line {reader.line_num}"


def _hold(
    points: dict[str, dict[tuple[int, int], tuple[float, ...]]], row: dict[str, str], at: tuple[int, int], where: str
) -> None:
    """Add a row's pixel and covariance to its image's points."""
    try:
        values = (float(row["x"]), float(row["y"]), *_covariance(row))
    except (TypeError, ValueError) as exc:
        raise BadInputError(KIND, f"{where}: {exc}") from exc
    if not np.isfinite(values).all():
        raise BadInputError(KIND, f"{where}: x, y and their noise are finite, got {values}")
    held = points.setdefault(str(row["image"]), {})
    if at in held:
        raise BadInputError(KIND, f"{where}: point {at[0]}, {at[1]} of {row['image']} comes twice")
    held[at] = values


def write_table(documents: Iterable[CornerFile]) -> str:
    """A table of corner documents; the mirror of `read_table`. Images without a board are not in it."""
    lines = [",".join((*NEEDED, *SPREAD))]
    for document in documents:
        for each in document.corners:
            (xx, xy), (_, yy) = each.covariance_px2
            numbers = ",".join(repr(value) for value in (*each.pixel, xx, xy, yy))
            lines.append(f"{_quoted(document.image)},{each.column},{each.row},{numbers}")
    return "\n".join(lines) + "\n"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\n') else name


def _covariance(row: dict[str, str]) -> tuple[float, float, float]:
    if row.get("xx"):
        xx, xy, yy = (float(row[column]) for column in SPREAD)
        if not (xx > 0 and yy > 0 and xx * yy > xy * xy):
            raise ValueError(f"xx, xy, yy are no covariance: {xx:g}, {xy:g}, {yy:g}")
        return xx, xy, yy
    sigma = float(row["sigma"]) if row.get("sigma") else SIGMA_PX
    if not sigma > 0:
        raise ValueError(f"sigma is above 0, got {sigma:g}")
    return sigma**2, 0.0, sigma**2


def _image(name: str, points: dict[tuple[int, int], tuple[float, ...]], columns: int, rows: int) -> ListedImage:
    values: Floats = np.full((columns * rows, 5), np.nan)
    for (column, row), numbers in points.items():
        values[row * columns + column] = numbers
    return ListedImage(name, values[:, :2], values[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
