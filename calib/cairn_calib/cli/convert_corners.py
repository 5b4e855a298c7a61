"""Turn corners that other programs found into corner documents for `cairn calib solve`, and back.

    $ cairn calib convert-corners corners.vnl corners/left --images '*-cam0.jpg' --board 10x10 --square 0.0588
    corners/left: 46 images, 43 with a board of 10x10 points, from mrcal
    $ cairn calib convert-corners left.yml corners/left --square 0.025           # OpenCV: image_points
    $ cairn calib convert-corners left.mat corners/left --square 0.025           # MATLAB: imagePoints, boardSize
    $ cairn calib convert-corners left.csv corners/left --square 0.025 --size 1280x960
    $ cairn calib solve corners/left corners/right --spectrum colour --output rig.json
    $ cairn calib convert-corners corners/left corners/right corners.vnl         # for mrcal; also to .csv

What OUT is decides the way: a folder gets a document for each image of one camera; a .vnl or .csv file gets all images
of the folders before it.

    IN              a file holds                            noise                      names of images
    .vnl            filename x y [level or weight]          2^level, or 1 / weight     yes
    .yml .xml .json OpenCV's calibration sample, -op        the same for all           no: numbered
    .mat            imagePoints, boardSize; save -v7        the same for all           imageFileNames
    .csv            image,column,row,x,y[,sigma]            sigma, pixels              yes

In MATLAB: `[imagePoints, boardSize, used] = detectCheckerboardPoints(files); imageFileNames = files(used);`, then
`save('left.mat', 'imagePoints', 'boardSize', 'imageFileNames', '-v7')`; of a stereo pair, one camera's points a file.

Points with names of their own, at any places of a flat board (pins, lamps, heated dots; bright or dark): a table of
their places for --points, and one of where each is in the images; no --board, no --square. --blobs moves a point that
was clicked by hand to the middle of the bright or dark blob that it is on, and states how certain that is.

    $ cairn calib convert-corners seen.csv corners/thermal --points pins.csv --blobs 8
    pins.csv: point,x_m,y_m                seen.csv: image,point,x,y[,sigma]

Points are in the board's order, row by row (MATLAB's, which go column by column, are turned). `--square` is the edge
of a cell in metres; `--board` is needed where the file does not say it, for .vnl. How large the images are is taken
from the file, or from the images themselves, if they are where the file says, or next to it; else say `--size`.

Two cameras belong together by the names of their images. A file without names numbers the images that showed a board:
two cameras' numbers then agree only if both lists hold the same moments. mrcal-calibrate-cameras reads the written
.vnl with --corners-cache-has-weights; a table (.csv) keeps the whole covariance.
"""

import argparse
import hashlib
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cairn_calib.board.board import Board, board_size, named_board
from cairn_calib.board.corner_file import CornerFile, read_corner_file
from cairn_calib.board.corner_pictures import overlay, write_picture
from cairn_calib.corner_search.blob_middle import REACH_MAX_PX, blob_middle
from cairn_calib.exchange.corner_list import KIND, CornerList, board_of, documents
from cairn_calib.exchange.corner_table import read_named_places, read_named_table, read_table, write_table
from cairn_calib.exchange.matlab_corners import read_matlab_points
from cairn_calib.exchange.mrcal_corners import read_vnl, write_vnl
from cairn_calib.exchange.opencv_corners import read_opencv_points
from cairn_calib.rig.image_files import read_bounded, read_grey
from cairn_map.errors import BadInputError

if TYPE_CHECKING:
    from argparse import _SubParsersAction

WRITERS = {".vnl": write_vnl, ".csv": write_table}
OPENCV = (".yml", ".yaml", ".xml", ".json")
FILE_BYTES_MAX = 256 << 20


def add_parser(commands: "_SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add `convert-corners` to `cairn calib`."""
    added = commands.add_parser(
        "convert-corners",
        help="corners of mrcal, OpenCV and MATLAB as documents for solve, and back",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.add_argument("files", nargs="+", type=Path, metavar="IN", help="a file of corners; or folders, to a file")
    added.add_argument("out", type=Path, metavar="OUT", help="a folder of documents; or a .vnl or .csv file")
    added.add_argument("--board", metavar="COLUMNSxROWS", help="inner corners, such as 9x6, where IN does not say it")
    added.add_argument("--square", type=float, metavar="METRES", help="edge of a cell; from disc to disc")
    added.add_argument(
        "--pattern", choices=("chessboard", "circles", "asymmetric-circles"), default="chessboard", help="(chessboard)"
    )
    added.add_argument("--disc", type=float, metavar="METRES", help="diameter of a disc, for grids of discs")
    added.add_argument("--size", metavar="WIDTHxHEIGHT", help="of the images, where neither IN nor they say it")
    added.add_argument("--points", type=Path, metavar="CSV", help="named points of the board: point,x_m,y_m")
    added.add_argument(
        "--blobs", type=float, metavar="PX", help="points are clicks, at most this far from blobs' middles"
    )
    added.add_argument("--images", metavar="PATTERN", help="only these, such as '*-cam0.jpg': one camera of several")
    added.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Convert, and report what was written on standard output."""
    if args.out.suffix in WRITERS:
        _export(args.files, args.out)
    elif len(args.files) > 1:
        raise BadInputError(
            "bad_arguments", f"one file at a time becomes a folder of documents, or OUT is a .vnl or .csv: {args.out}"
        )
    else:
        _import(args)


def _import(args: argparse.Namespace) -> None:
    path: Path = args.files[0]
    listed, board = _listed_and_board(path, args)
    places = [_image_path(each.name, path) for each in listed.images]
    if args.blobs is not None:
        listed = _with_blobs(listed, places, args.blobs)
    stated = None if args.size is None else (None, _size(args.size))
    # Read one after another: all pictures of a session do not fit into memory.
    files = [stated if place is None else _digest_and_size(place) for place in places]
    found = []
    args.out.mkdir(parents=True, exist_ok=True)
    for (stem, document), place in zip(documents(listed, board, source=path.name, files=files), places, strict=True):
        (args.out / f"{stem}.json").write_text(document.model_dump_json(indent=1) + "\n", encoding="utf-8")
        if place is not None:
            title = f"{document.image}: {len(document.corners)} of {board.count} corners from {path.name}"
            write_picture(args.out / f"{stem}.png", overlay(read_grey(place)[0], document.to_corners(), title=title))
        found.append(bool(document.corners))
    points = f"{board.count} named" if board.named is not None else f"{board.columns}x{board.rows}"
    sys.stdout.write(
        f"{args.out}: {len(found)} images, {sum(found)} with a board of {points} points, from {listed.program}\n"
    )
    if not listed.is_named:
        sys.stderr.write(
            f"{path.name} names no images: they are numbered as they stand in it. Another camera's belong to the same "
            "moments only if its file lists the same ones\n"
        )


def _listed_and_board(path: Path, args: argparse.Namespace) -> tuple[CornerList, Board]:
    """The images of a file, as far as they are wanted, and their board."""
    if args.points is not None:
        if path.suffix != ".csv" or args.board is not None or args.square is not None:
            raise BadInputError("bad_arguments", "--points is of a table (.csv), without --board and --square")
        board = named_board(read_named_places(_text(args.points), name=args.points.name))
        listed = read_named_table(_text(path), board=board, name=path.name)
        return (listed if args.images is None else listed.matching(args.images)), board
    if args.square is None or not 0 < args.square <= 100:
        raise BadInputError("bad_board", f"--square is an edge in metres, above 0 and at most 100, got {args.square}")
    size = None if args.board is None else board_size(args.board)
    listed = _read(path, size)
    listed = listed if args.images is None else listed.matching(args.images)
    return listed, board_of(listed, size=size, pitch_m=args.square, pattern=args.pattern, disc_m=args.disc)


def _with_blobs(listed: CornerList, places: Sequence[Path | None], reach_px: float) -> CornerList:
    """The list with each point moved to the middle of its blob; points without one are hidden, and named."""
    if not 1 <= reach_px <= REACH_MAX_PX:
        raise BadInputError("bad_arguments", f"--blobs is 1 to {REACH_MAX_PX:g} pixels, got {reach_px:g}")
    images = []
    for image, place in zip(listed.images, places, strict=True):
        if place is None:
            raise BadInputError(KIND, f"--blobs looks into the images, and {image.name} is not there")
        counts, _ = read_grey(place)
        pixels, covariance_px2 = image.pixels.copy(), image.covariance_px2.copy()
        for n in np.flatnonzero(np.isfinite(pixels[:, 0])):
            found = blob_middle(counts, pixels[n], reach_px)
            if isinstance(found, str):
                x, y = pixels[n]
                sys.stderr.write(f"{image.name}: the point at ({x:.0f}, {y:.0f}) is left out: {found}\n")
                pixels[n], covariance_px2[n] = np.nan, np.nan
            else:
                pixels[n], covariance_px2[n] = found.pixel, found.covariance_px2
        images.append(replace(image, pixels=pixels, covariance_px2=covariance_px2))
    return replace(listed, images=tuple(images))


def _text(path: Path) -> str:
    try:
        return read_bounded(path, FILE_BYTES_MAX).decode("utf-8-sig")
    except UnicodeDecodeError as exc:
        raise BadInputError(KIND, f"{path} is no text: {exc.reason} at byte {exc.start}") from exc


def _read(path: Path, size: tuple[int, int] | None) -> CornerList:
    if path.suffix == ".mat":
        return read_matlab_points(read_bounded(path, FILE_BYTES_MAX), stem=path.stem, name=path.name)
    text = _text(path)
    if path.suffix == ".vnl":
        return read_vnl(text, name=path.name)
    if path.suffix == ".csv":
        return read_table(text, board_size=size, name=path.name)
    if path.suffix in OPENCV:
        return read_opencv_points(text, stem=path.stem, name=path.name)
    raise BadInputError("bad_arguments", f"{path.name} is none of .vnl, {', '.join(OPENCV)}, .mat and .csv")


def _image_path(name: str, source: Path) -> Path | None:
    """The image's file, as the list names it or next to the list; None where it is in neither place."""
    plain = Path(name.replace("\\", "/"))
    places = (plain, source.parent / plain, source.parent / plain.name)
    return next((place for place in places if place.suffix and place.is_file()), None)


def _digest_and_size(path: Path) -> tuple[str, tuple[int, int]]:
    counts, data = read_grey(path)
    return hashlib.sha256(data).hexdigest(), (counts.shape[1], counts.shape[0])


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None or not all(1 <= int(side) <= 16384 for side in found.groups()):
        raise BadInputError("bad_arguments", f"--size is WIDTHxHEIGHT in pixels, such as 1280x960, got {text[:40]!r}")
    return int(found[1]), int(found[2])


def _export(folders: Sequence[Path], out: Path) -> None:
    found: list[CornerFile] = []
    for folder in folders:
        paths = sorted(folder.glob("*.json"))
        if not paths:
            raise BadInputError(
                KIND, f"{folder} holds no corner documents (*.json): make them with cairn calib corners"
            )
        for path in paths:
            document = read_corner_file(path)
            # Two cameras' images may have the same names: their folders tell them apart.
            name = f"{folder.resolve().name}/{document.image}" if len(folders) > 1 else document.image
            found.append(document.model_copy(update={"image": name}))
    if any(document.board != found[0].board for document in found):
        raise BadInputError(KIND, "the documents are of several boards: a file of corners holds one")
    try:
        out.write_text(WRITERS[out.suffix](found), encoding="utf-8")
    except OSError as exc:
        raise BadInputError(KIND, f"cannot write {out}: {exc.strerror}") from exc
    with_board = sum(bool(document.corners) for document in found)
    sys.stdout.write(f"{out}: {len(found)} images, {with_board} with a board\n")
