"""Options of `cairn calib corners` that describe the board, counted and measured as the makers of its sheet do."""

import argparse

from pydantic import ValidationError

from cairn_calib.board.board import CODED, Board, board_size
from cairn_calib.corner_search.tag_codes import dictionary_of
from cairn_map.errors import BadInputError, first_error

PATTERNS = ("chessboard", "circles", "asymmetric-circles", "charuco", "aprilgrid")
COUNTED = {"charuco": "squares, dark and bright", "aprilgrid": "tags"}
"""Parts that `--board` counts, where they are no points."""
NM = 9
"""Decimals of a pitch in metres that is a sum of what was stated."""


def add_board_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        "--board",
        required=True,
        metavar="COLUMNSxROWS",
        help="inner corners, discs, squares of a ChArUco board, tags of an AprilGrid; such as 9x6",
    )
    parser.add_argument(
        "--square", type=float, required=True, metavar="METRES", help="edge of a cell; of an AprilGrid, of a tag"
    )
    parser.add_argument("--pattern", choices=PATTERNS, default="chessboard", help="(chessboard)")
    parser.add_argument("--disc", type=float, metavar="METRES", help="diameter of a disc, for grids of discs")
    parser.add_argument("--marker", type=float, metavar="METRES", help="edge of a tag, of a ChArUco board")
    parser.add_argument(
        "--spacing", type=float, metavar="RATIO", help="gap between tags over a tag's edge, of an AprilGrid (0.3)"
    )
    parser.add_argument(
        "--tags", metavar="SET", help="of a board with tags, such as 5x5_100 or 36h11 (of an AprilGrid)"
    )


def board_by_options(args: argparse.Namespace) -> Board:
    """The board that the options describe.

    Raises:
        BadInputError: they describe none.
    """
    if not 0 < args.square <= 100:
        raise BadInputError("bad_board", f"--square is an edge in metres, above 0 and at most 100, got {args.square}")
    if "circles" not in args.pattern and args.disc is not None:
        raise BadInputError(
            "bad_board", f"--disc is of discs, and a {args.pattern} has none: leave it out, or say --pattern circles"
        )
    if (args.pattern == "charuco") != (args.marker is not None):
        raise BadInputError(
            "bad_board", "--marker is the edge in metres of a ChArUco board's tags: give it for such a board alone"
        )
    if args.spacing is not None and not (args.pattern == "aprilgrid" and 0 < args.spacing <= 2):
        raise BadInputError(
            "bad_board",
            "--spacing is the gap between the tags of an AprilGrid over a tag's edge, such as 0.3, at most 2",
        )
    if args.tags is not None and args.pattern not in CODED:
        raise BadInputError("bad_board", f"--tags names the tags of {' or '.join(CODED)}: say --pattern")
    try:
        board = _coded_board(args) if args.pattern in CODED else _plain_board(args)
    except ValidationError as exc:
        raise BadInputError("bad_board", f"--board, --square: {first_error(exc)}") from exc
    _refuse_turns(board, args)
    return board


def _refuse_turns(board: Board, args: argparse.Namespace) -> None:
    if board.has_turn_symmetry and not args.upright and args.outer_corners is None:
        better = (
            "one with an odd and an even side" if args.pattern == "chessboard" else "asymmetric circles in odd rows"
        )
        raise BadInputError(
            "board_turns",
            f"a board of {args.board} {args.pattern} looks the same after half a turn, so that no image shows which of "
            "its points is the first: add --upright if its rows always run from left to right in the images (for a "
            f"rig of one camera any point may be the first: add it, too), or use another board: {better}",
        )


def _plain_board(args: argparse.Namespace) -> Board:
    columns, rows = board_size(args.board)
    return Board(pattern=args.pattern, columns=columns, rows=rows, pitch_m=args.square, disc_m=args.disc)


def _coded_board(args: argparse.Namespace) -> Board:
    columns, rows = board_size(args.board, of=COUNTED[args.pattern], least=2 if args.pattern == "aprilgrid" else 4)
    if args.pattern == "charuco":
        if args.tags is None:
            raise BadInputError("bad_board", "--tags is the set of the ChArUco board's tags, such as 5x5_100: give it")
        dictionary_of(args.tags)
        return Board(
            pattern="charuco",
            columns=columns - 1,
            rows=rows - 1,
            pitch_m=args.square,
            tag_m=args.marker,
            dictionary=args.tags,
        )
    dictionary_of(args.tags or "36h11")
    spacing = 0.3 if args.spacing is None else args.spacing
    return Board(
        pattern="aprilgrid",
        columns=2 * columns,
        rows=2 * rows,
        pitch_m=round(args.square * (1 + spacing), NM),
        tag_m=args.square,
        dictionary=args.tags or "36h11",
    )
