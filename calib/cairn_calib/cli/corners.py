"""Find the corners of a calibration board in images of any spectrum.

    $ cairn calib corners left/*.png --board 9x6 --square 0.05 --output corners/
    left01.png: 54 of 54 corners, sigma 0.02 px (saddles x1)
    left02.png: no board (candidates: 31 places look like a corner, the board has 54)
    polarity normal: 11 for normal, 0 for reversed of 13 images
    found in 12 of 13 images; the others: left02.png; look at corners/*.png

`--board` counts inner corners, not cells; one number should be odd and the other even, since of other boards no
image tells which way up they are (`--upright` says that yours always stands upright). `--square` is the edge of a cell
in metres. Colour, near-infrared amplitude and thermal images need no options. Where a camera
sees the printed dark cells bright, as a thermal camera sees a heated board, the board's margin tells, by a vote of all
images: run the command once for each camera, with all of its images. Corners are then named in the same order in all
cameras, which a joint calibration relies on. Of a board without a paper-white margin say `--polarity` yourself.

Noisy cameras: take several frames of each still pose and give a folder for each pose instead of an image; its frames
are averaged (corners of 8 are almost 3 times as certain), and a board that moved between them is refused.

    $ cairn calib corners tof/pose01 tof/pose02 tof/pose03 --board 9x6 --square 0.05 --output corners/tof

Each image gets a JSON document of its corners with covariances in pixels squared (CONVENTIONS.md), and a picture to
look at. Parts of the board may be hidden, but each of its four sides must be seen in part. What only looks like a
board is refused, and both files say at which stage; so is an image that repeats another one, count for count. An
image that cannot be read is named, and the others are done.

Where detection fails, help it: name the outer four of the inner corners, to a few pixels, in the order first, end of
first row, end of last row, start of last row, and pass the file as `--outer-corners`:

    {"format": "cairn-outer-corners", "version": 1,
     "images": {"left02.png": [[412, 96], [688, 130], [655, 310], [401, 288]]}}

For grids of discs say `--pattern circles` or `asymmetric-circles`; `--square` is then from disc to disc, and `--disc`
their diameter: the centroid of a tilted disc's image is not its centre's, which `cairn calib solve` must know.
If no board was found in any image, that is an error (exit code 3).
"""

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from cairn_calib.board.board import Board, Polarity, board_size
from cairn_calib.board.corner_detection import grey
from cairn_calib.board.corner_file import CornerFile, corner_file, read_outer_corners
from cairn_calib.board.corner_pictures import overlay, write_picture
from cairn_calib.board.corners import Attempt, Detection
from cairn_calib.board.polarity import PolarityCandidates, chessboard_candidates, count_votes, disc_candidates
from cairn_calib.board.still_frames import StillImage, read_still, refuse_movement
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, CairnError, DamagedDataError, NotFoundError, first_error
from cairn_map.progress import with_passing_progress

NAMED_MAX = 8
"""Images without a board that the last line names."""


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
    corners.add_argument(
        "images",
        type=Path,
        nargs="+",
        metavar="IMAGE",
        help="PNG, JPEG, TIFF, 8 or 16 bits; folder: a still pose",
    )
    corners.add_argument("--board", required=True, metavar="COLUMNSxROWS", help="inner corners, such as 9x6")
    corners.add_argument("--square", type=float, required=True, metavar="METRES", help="edge of a cell")
    corners.add_argument("--output", type=Path, required=True, metavar="DIR", help="for the documents and pictures")
    corners.add_argument(
        "--pattern", choices=("chessboard", "circles", "asymmetric-circles"), default="chessboard", help="(chessboard)"
    )
    corners.add_argument("--disc", type=float, metavar="METRES", help="diameter of a disc, for grids of discs")
    corners.add_argument(
        "--polarity",
        choices=("vote", "normal", "reversed"),
        default="vote",
        help="reversed: what is printed dark looks bright; vote: the images tell (vote)",
    )
    corners.add_argument(
        "--upright", action="store_true", help="rows of the board run along rows of the image, left to right"
    )
    corners.add_argument("--outer-corners", type=Path, metavar="FILE", help="corners pointed at by hand, JSON")
    corners.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    board = _board(args)
    pointed = read_outer_corners(args.outer_corners, board) if args.outer_corners else {}
    names = [_name(path) for path in args.images]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInputError("image_name", f"images must have names of their own, {', '.join(twice)} comes twice")
    for path, name in zip(args.images, names, strict=True):
        # A picture among a still pose's frames would be one of them the next time.
        if path.resolve() in ((args.output / f"{name}.png").resolve(), args.output.resolve()):
            raise BadInputError(
                "image_name", f"the picture of {path}'s corners would overwrite it: give another --output"
            )
    by_hand = args.outer_corners.resolve() if args.outer_corners else None
    if by_hand in [(args.output / f"{name}.json").resolve() for name in names]:
        raise BadInputError("image_name", f"a document of corners would overwrite {args.outer_corners}: move that")
    missing = [str(path) for path in args.images if not path.exists()]
    if missing:
        raise BadInputError("missing_image", f"no such images: {', '.join(missing)}")
    unknown = sorted(set(pointed) - {path.name for path in args.images})
    if unknown:
        raise BadInputError(
            "image_name", f"{args.outer_corners} names images that were not given: {', '.join(unknown)}"
        )
    args.output.mkdir(parents=True, exist_ok=True)
    seen_before: dict[bytes, str] = {}
    results = [
        _find_and_draw(path, board, args, pointed.get(path.name), seen_before)
        for path in with_passing_progress(args.images, "images", total=len(args.images))
    ]
    polarity = _polarity([each.candidates for each in results], args)
    for each in results:
        if each.candidates.detection(polarity).corners is not each.candidates.likely.corners:
            _draw(each.path, read_still(each.path), each.candidates.detection(polarity), args.output)
        document = each.document(board, polarity).model_dump_json(indent=1)
        (args.output / f"{_name(each.path)}.json").write_text(document + "\n", encoding="utf-8")
    lost = [each.path.name for each in results if each.candidates.detection(polarity).corners is None]
    found = len(args.images) - len(lost)
    more = f" and {len(lost) - NAMED_MAX} more" if len(lost) > NAMED_MAX else ""
    others = f"; the others: {', '.join(lost[:NAMED_MAX])}{more}" if lost else ""
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


def _name(path: Path) -> str:
    return path.resolve().name if path.is_dir() else path.stem


@dataclass(frozen=True, slots=True)
class _ImageResult:
    """Detections in one image; without digest and size where it cannot be read."""

    path: Path
    candidates: PolarityCandidates
    sha256: str | None
    size: tuple[int, int] | None
    frames: int

    def document(self, board: Board, polarity: Polarity) -> CornerFile:
        """Document of its corners, to be written once all images have voted."""
        return corner_file(
            self.candidates.detection(polarity),
            board,
            image=self.path.name,
            sha256=self.sha256,
            size=self.size,
            polarity=polarity,
            frames=self.frames,
        )


def _find_and_draw(
    path: Path, board: Board, args: argparse.Namespace, pointed: Floats | None, seen_before: dict[bytes, str]
) -> _ImageResult:
    """Find the board in one image, report and draw it; `seen_before` names images by the digest of their counts."""
    try:
        image = read_still(path)
        grey(image.counts)
    except (BadInputError, DamagedDataError) as exc:
        unread = _no_detection("reading", exc.message)
        (args.output / f"{_name(path)}.png").unlink(missing_ok=True)  # of another image of this name
        _say(_line(path, unread.likely))
        return _ImageResult(path, unread, None, None, 1)
    candidates = _find(image, path, board, args, pointed, seen_before)
    _say(_line(path, candidates.likely))
    _draw(path, image, candidates.likely, args.output)
    height, width = image.counts.shape
    return _ImageResult(path, candidates, image.sha256, (width, height), image.frames)


def _find(
    image: StillImage,
    path: Path,
    board: Board,
    args: argparse.Namespace,
    pointed: Floats | None,
    seen_before: dict[bytes, str],
) -> PolarityCandidates:
    twin = seen_before.setdefault(hashlib.sha256(image.counts.tobytes()).digest(), path.name)
    if twin != path.name:
        # The board has moved since, and its place is not in it.
        why = f"the same counts as {twin}; cameras repeat an image when they lose one, or level themselves"
        return _no_detection("repeated", why)
    look = disc_candidates if board.pattern != "chessboard" else chessboard_candidates
    found = look(image.counts, board, polarity=args.polarity, upright=args.upright, pointed=pointed)
    return found.filter(lambda detection: refuse_movement(image, detection))


def _draw(path: Path, image: StillImage, detection: Detection, folder: Path) -> None:
    write_picture(folder / f"{_name(path)}.png", overlay(image.counts, detection.corners, title=_line(path, detection)))


def _line(path: Path, detection: Detection) -> str:
    return f"{path.name}: {_outcome(detection)}"


def _polarity(candidates: Sequence[PolarityCandidates], args: argparse.Namespace) -> Polarity:
    chosen: Polarity | Literal["vote"] = args.polarity
    if chosen != "vote":
        return chosen
    vote = count_votes([each.vote for each in candidates])
    if vote.polarity is not None:
        _say(f"polarity {vote.polarity}: {vote} of {len(candidates)} images")
        return vote.polarity
    if any(each.likely.corners is not None for each in candidates):
        _say(
            f"polarity unknown, taken for normal: {vote} of {len(candidates)} images; if this camera sees what is "
            "printed dark as bright, say --polarity reversed"
        )
    return "normal"


def _no_detection(stage: str, reason: str) -> PolarityCandidates:
    """Candidates of an image in which no corners were searched, with the reason."""
    nothing = Detection(None, (Attempt("image", 1.0, stage, reason),))
    return PolarityCandidates(nothing, nothing, None)


def _outcome(detection: Detection) -> str:
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
