"""Find the corners of a calibration board in images of any spectrum.

    $ cairn calib corners left/*.png --board 9x6 --square 0.05 --output corners/
    left01.png: 54 of 54 corners, sigma 0.02 px (saddles x1)
    left02.png: no board (candidates: 31 places look like a corner, the board has 54)
    found in 12 of 13 images; the others: left02.png; look at corners/*.png

`--board` counts inner corners, not cells; one number should be odd and the other even, since of other boards no
image tells which way up they are (`--upright` says that yours always stands upright). `--square` is the edge of a cell
in metres. Colour, near-infrared amplitude and thermal images need no options but one: where the camera sees the
printed dark cells bright, as a thermal camera sees a heated board, say `--polarity reversed`. Their order is then
the same in all cameras, which a joint calibration relies on: run the command once for each camera.

Each image gets a JSON document of its corners with covariances in pixels squared (CONVENTIONS.md), and a picture to
look at. Parts of the board may be hidden, but each of its four sides must be seen in part. What only looks like a
board is refused, and both files say at which stage.

Where detection fails, help it: name the outer four of the inner corners, to a few pixels, in the order first, end of
first row, end of last row, start of last row, and pass the file as `--outer-corners`:

    {"format": "cairn-outer-corners", "version": 1,
     "images": {"left02.png": [[412, 96], [688, 130], [655, 310], [401, 288]]}}

For grids of discs say `--pattern circles` or `asymmetric-circles`; `--square` is then from disc to disc, and `--disc`
their diameter: a tilted disc's image has its centroid beside its centre, which `cairn calib solve` must know.
If no board was found in any image, that is an error (exit code 3).
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from cairn_calib.board import Board, board_size
from cairn_calib.circle_grid import find_circles
from cairn_calib.corner_detection import find_chessboard, fit_pointed_at
from cairn_calib.corner_file import corner_file, read_outer_corners
from cairn_calib.corner_pictures import Grey, overlay, read_grey, write_picture
from cairn_calib.corners import Detection
from cairn_map.errors import BadInputError, CairnError, NotFoundError, first_error

Floats = npt.NDArray[np.float64]


def add_parser(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand."""
    corners = commands.add_parser(
        "corners",
        help="find the corners of a board in images",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_arguments(corners)


def main(argv: list[str]) -> int:
    """Run the subcommand alone."""
    corners = argparse.ArgumentParser(
        "cairn calib corners", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    _add_arguments(corners)
    return _run(corners.parse_args(argv))


def _add_arguments(corners: argparse.ArgumentParser) -> None:
    corners.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="PNG, JPEG or TIFF, 8 or 16 bits")
    corners.add_argument("--board", required=True, metavar="COLUMNSxROWS", help="inner corners, such as 9x6")
    corners.add_argument("--square", type=float, required=True, metavar="METRES", help="edge of a cell")
    corners.add_argument("--output", type=Path, required=True, metavar="DIR", help="for the documents and pictures")
    corners.add_argument(
        "--pattern", choices=("chessboard", "circles", "asymmetric-circles"), default="chessboard", help="(chessboard)"
    )
    corners.add_argument("--disc", type=float, metavar="METRES", help="diameter of a disc, for grids of discs")
    corners.add_argument(
        "--polarity",
        choices=("normal", "reversed"),
        default="normal",
        help="reversed: what is printed dark looks bright (normal)",
    )
    corners.add_argument(
        "--upright", action="store_true", help="rows of the board run along rows of the image, left to right"
    )
    corners.add_argument("--outer-corners", type=Path, metavar="FILE", help="corners pointed at by hand, JSON")
    corners.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    board = _board(args)
    pointed = read_outer_corners(args.outer_corners, board) if args.outer_corners else {}
    names = [path.stem for path in args.images]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInputError("image_name", f"images must have names of their own, {', '.join(twice)} comes twice")
    unknown = sorted(set(pointed) - {path.name for path in args.images})
    if unknown:
        raise BadInputError(
            "image_name", f"{args.outer_corners} names images that were not given: {', '.join(unknown)}"
        )
    args.output.mkdir(parents=True, exist_ok=True)
    lost = []
    for path in args.images:
        counts, data = read_grey(path)
        detection = _detected(counts, board, args, pointed.get(path.name))
        document = corner_file(
            detection, board, image=path.name, data=data, size=counts.shape[::-1], polarity=args.polarity
        )
        (args.output / f"{path.stem}.json").write_text(document.model_dump_json(indent=1) + "\n", encoding="utf-8")
        line = f"{path.name}: {_told(detection)}"
        write_picture(args.output / f"{path.stem}.png", overlay(counts, detection.corners, title=line))
        _say(line)
        if detection.corners is None:
            lost.append(path.name)
    found = len(args.images) - len(lost)
    others = f"; the others: {', '.join(lost)}" if lost else ""
    _say(f"found in {found} of {len(args.images)} images{others}; look at {args.output}/*.png")
    if not found:
        raise NotFoundError(
            "no_board", f"no board in any image; {args.output}/*.json say at which stage each attempt ended"
        )
    return 0


def _board(args: argparse.Namespace) -> Board:
    columns, rows = board_size(args.board)
    if not 0 < args.square <= 100:
        raise BadInputError("bad_board", f"--square is an edge in metres, above 0 and at most 100, got {args.square}")
    if (args.pattern == "chessboard") != (args.disc is None):
        raise BadInputError("bad_board", "--disc is the diameter in metres of a grid's discs: give it for them alone")
    try:
        return Board(pattern=args.pattern, columns=columns, rows=rows, pitch_m=args.square, disc_m=args.disc)
    except ValidationError as exc:
        raise BadInputError("bad_board", f"--disc: {first_error(exc)}") from exc


def _detected(counts: Grey, board: Board, args: argparse.Namespace, pointed: Floats | None) -> Detection:
    if board.pattern != "chessboard":
        return find_circles(counts, board, polarity=args.polarity, upright=args.upright, pointed=pointed)
    if pointed is not None:
        return fit_pointed_at(counts, board, pointed)
    return find_chessboard(counts, board, polarity=args.polarity, upright=args.upright)


def _told(detection: Detection) -> str:
    last = detection.attempts[-1]
    if detection.corners is None:
        furthest = max(detection.attempts, key=lambda attempt: attempt.stage != "candidates")
        return f"no board ({furthest.stage}: {furthest.reason})"
    seen = detection.corners.seen
    sigma = float(np.sqrt(np.nanmedian(np.trace(detection.corners.covariance_px2, axis1=1, axis2=2) / 2)))
    return f"{seen.sum()} of {len(seen)} corners, sigma {sigma:.3f} px ({last.method} x{last.scale:g})"


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


if __name__ == "__main__":
    try:
        code = main(sys.argv[1:])
    except CairnError as exc:
        _say(f"cairn calib corners: {exc.message} [{exc.kind}]")
        code = 1
    sys.exit(code)
