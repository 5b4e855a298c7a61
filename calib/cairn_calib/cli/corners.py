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
image that cannot be read is named, and the others are done. All cores work, an image each; each document is written
as its image is done, so that after ^C or a power cut the same command with --resume goes on:

    $ cairn calib corners left/*.png --board 9x6 --square 0.05 --output corners/ --resume

Where detection fails, help it: name the outer four of the inner corners, to a few pixels, in the order first, end of
first row, end of last row, start of last row, and pass the file as `--outer-corners`:

    {"format": "cairn-outer-corners", "version": 1,
     "images": {"left02.png": [[412, 96], [688, 130], [655, 310], [401, 288]]}}

For grids of discs say `--pattern circles` or `asymmetric-circles`; `--square` is then from disc to disc, and `--disc`
their diameter: the centroid of a tilted disc's image is not its centre's, which `cairn calib solve` must know. Without
it the images show it, to about 1 %. Discs that the image's border cuts are left out.

Boards with tags may be seen in part, and any way up: tags name the corners. Of OpenCV's ChArUco board `--board` counts
squares, and `--marker` is the edge of a tag. Of Kalibr's AprilGrid it counts tags, `--square` is the edge of a tag from
black to black (`tagSize`), `--spacing` the gap over that edge (`tagSpacing`):

    $ cairn calib corners left/*.png --pattern charuco --board 11x8 --square 0.03 --marker 0.022 --tags 5x5_100 ...
    $ cairn calib corners left/*.png --pattern aprilgrid --board 6x6 --square 0.088 --spacing 0.3 ...

If no board was found in any image, that is an error (exit code 3).
"""

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from cairn_calib.board.board import Polarity
from cairn_calib.board.corner_file import read_outer_corners
from cairn_calib.board.polarity import count_votes
from cairn_calib.cli.board_options import add_board_options, board_by_options
from cairn_calib.corner_search.corner_folder import document_path, image_name, picture_path, write_outcome
from cairn_calib.corner_search.image_search import (
    BoardSearch,
    ImageTask,
    SearchedImage,
    outcome_line,
    repeat_of,
    settle,
)
from cairn_calib.corner_search.search_workers import search_images
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError, CairnError, NotFoundError
from cairn_map.progress import with_passing_progress

DISC_RATIO = 1.07
"""Ratio of the stated and the seen diameter of discs above which a warning is printed."""
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
    add_board_options(corners)
    corners.add_argument("--output", type=Path, required=True, metavar="DIR", help="for the documents and pictures")
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
    corners.add_argument("--resume", action="store_true", help="keep what an earlier run of this command has done")
    corners.add_argument("--jobs", type=int, metavar="N", help="images at a time (the machine's cores)")
    corners.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    board = board_by_options(args)
    pointed = read_outer_corners(args.outer_corners, board) if args.outer_corners else {}
    names = [image_name(path) for path in args.images]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInputError("image_name", f"images must have names of their own, {', '.join(twice)} comes twice")
    for path in args.images:
        # A picture among a still pose's frames would be one of them the next time.
        if path.resolve() in (picture_path(args.output, path).resolve(), args.output.resolve()):
            raise BadInputError(
                "image_name", f"the picture of {path}'s corners would overwrite it: give another --output"
            )
    by_hand = args.outer_corners.resolve() if args.outer_corners else None
    if by_hand in [document_path(args.output, path).resolve() for path in args.images]:
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
    tasks = _tasks(args, BoardSearch(board, args.polarity, args.upright), pointed)
    results = _search_and_write(tasks, args)
    polarity = _polarity(results, args)
    results = [_settle_and_write(task, each, polarity, args) for task, each in zip(tasks, results, strict=True)]
    results = _settle_discs(tasks, results, args)
    lost = [each.document.image for each in results if not each.document.corners]
    found = len(args.images) - len(lost)
    more = f" and {len(lost) - NAMED_MAX} more" if len(lost) > NAMED_MAX else ""
    others = f"; the others: {', '.join(lost[:NAMED_MAX])}{more}" if lost else ""
    _say(f"found in {found} of {len(args.images)} images{others}; look at {args.output}/*.png")
    if not found:
        raise NotFoundError(
            "no_board", f"no board in any image; {args.output}/*.json say at which stage each attempt ended"
        )
    return 0


def _tasks(args: argparse.Namespace, search: BoardSearch, pointed: Mapping[str, Floats]) -> list[ImageTask]:
    return [
        ImageTask(
            path,
            search,
            pointed=pointed.get(path.name),
            document=document_path(args.output, path) if args.resume else None,
        )
        for path in args.images
    ]


def _search_and_write(tasks: Sequence[ImageTask], args: argparse.Namespace) -> list[SearchedImage]:
    """Outcomes of all images, each written and reported as it is done; their pictures are let go."""
    results: list[SearchedImage] = []
    seen_before: dict[bytes, str] = {}
    outcomes = search_images(tasks, jobs=_jobs(args.jobs))
    try:
        for each in with_passing_progress(outcomes, "images", total=len(tasks)):
            task, searched = tasks[len(results)], each
            if each.counts_sha256 is not None:
                first = seen_before.setdefault(each.counts_sha256, task.path.name)
                searched = each if first == task.path.name else repeat_of(each, task, first)
            if not searched.is_kept:
                write_outcome(args.output, task.path, searched)
                _say(outcome_line(searched.document))
            results.append(replace(searched, picture=None))
    except KeyboardInterrupt:
        _say(f"stopped after {len(results)} of {len(tasks)} images; the same command with --resume goes on")
        raise
    kept = sum(each.is_kept for each in results)
    if args.resume:
        _say(f"resumed: {kept} of {len(tasks)} images were done")
    return results


def _settle_and_write(
    task: ImageTask, searched: SearchedImage, polarity: Polarity, args: argparse.Namespace
) -> SearchedImage:
    settled = settle(searched, task, polarity)
    if settled is not searched:
        write_outcome(args.output, task.path, settled)
    return settled


def _settle_discs(
    tasks: Sequence[ImageTask], results: list[SearchedImage], args: argparse.Namespace
) -> list[SearchedImage]:
    """The outcomes with the discs' diameter, which the images show where it is not stated."""
    shown = [each.document.disc_pitches for each in results if each.document.disc_pitches is not None]
    if not shown:
        return results
    pitches, images = float(np.median(shown)), f"{len(shown)} image{'s' * (len(shown) != 1)}"
    disc_m = float(f"{pitches * args.square:.3g}")
    if args.disc is not None:
        if not 1 / DISC_RATIO < disc_m / args.disc < DISC_RATIO:
            _say(
                f"warning: --disc says {args.disc:g} m, and in {images} discs are {disc_m:g} m across "
                f"({pitches:.2f} of --square): measure both, for a wrong diameter biases the focal length"
            )
        return results
    _say(f"discs are {disc_m:g} m across, as {images} show; --disc states it")
    settled = []
    for task, each in zip(tasks, results, strict=True):
        board = each.document.board.model_copy(update={"disc_m": disc_m})
        settled.append(replace(each, document=each.document.model_copy(update={"board": board})))
        write_outcome(args.output, task.path, settled[-1])
    return settled


def _jobs(jobs: int | None) -> int:
    if jobs is not None and jobs < 1:
        raise BadInputError("bad_arguments", f"--jobs is a number of processes, at least 1, got {jobs}")
    return jobs or os.cpu_count() or 1


def _polarity(results: Sequence[SearchedImage], args: argparse.Namespace) -> Polarity:
    chosen: Polarity | Literal["vote"] = args.polarity
    if chosen != "vote":
        return chosen
    vote = count_votes([each.document.vote for each in results])
    if vote.polarity is not None:
        _say(f"polarity {vote.polarity}: {vote} of {len(results)} images")
        return vote.polarity
    if any(each.document.corners for each in results):
        _say(
            f"polarity unknown, taken for normal: {vote} of {len(results)} images; if this camera sees what is "
            "printed dark as bright, say --polarity reversed"
        )
    return "normal"


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")


if __name__ == "__main__":
    try:
        code = main(sys.argv[1:])
    except CairnError as exc:
        _say(f"cairn calib corners: {exc.message} [{exc.kind}]")
        code = 1
    sys.exit(code)
