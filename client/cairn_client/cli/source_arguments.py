"""Command-line options that say what a source of scans is: shared by all commands that read recordings.

A folder of frames that is no recording takes options of its own: patterns, intrinsics, conventions.
"""

import argparse
from pathlib import Path

from pydantic import ValidationError

from cairn_client.cli.arguments import say
from cairn_client.cli.pose_arguments import add_convention_arguments, add_pose_arguments, pose_options
from cairn_fusion.recording.frame_folder import FrameFolderOptions, image_patterns
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.recording_format import Convention
from cairn_fusion.recording.turned_source import AXES_UP, turned_source
from cairn_map.errors import BadInputError, complaint_text

TEXT = """Any folder with one file per frame and image: give --depth, --pose, --intrinsics, and options of other images.
Patterns are relative to the folder and hold {id}, e.g. --depth 'frames/{id}.depth.png' --pose 'frames/{id}.pose.txt'.
Without --depth, folders named depth, rgb (color, image) and thermal (lwir) in any letters are taken as they are.
All images must be one raster (registered); a pose is a 4x4 matrix in text, without {id} one file for all frames.
An {id} such as 1305031102.160407 (seconds) or 1403636579763555584 (nanoseconds) is the frame's time."""
OPTIONS = (
    *("depth", "colour", "thermal", "pose", "distortion", "depth_units", "depth_convention"),
    *("kelvin_per_count", "kelvin_at_zero", "frame_rate"),
)
OPTIONS_OF_PATTERN = ("pose_convention", "axes")
"""Options of `--pose`; with `--poses` they are the pose file's."""
FIELD_OF_OPTION = {"depth_units": "depth_units_per_m", "frame_rate": "frame_rate_hz"}


def add_source_arguments(command: argparse.ArgumentParser, *, scale: tuple[str, ...] = ("--scale",)) -> None:
    """Add the options; `scale` are the names of the one about poses without metric scale."""
    command.add_argument(
        "--topics", type=Path, metavar="YAML", help="meaning of a bag's topics; see inspect (its own topics.yaml)"
    )
    add_frame_arguments(command)
    add_pose_arguments(command, scale=scale)
    command.add_argument(
        "--deskewed", action="store_true", help="points of clouds are moved to one time of their sweep already"
    )
    add_up_arguments(command)


def add_up_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options that say which way is up in the frame of the poses."""
    group = command.add_argument_group(
        "which way is up", "The map's z axis points up; `cairn robot inspect` proposes which axis of the poses does."
    )
    group.add_argument(
        "--up", type=str.strip, choices=AXES_UP, help="axis of the poses' frame that points up, and becomes z (z)"
    )
    group.add_argument(
        "--T-map-world", type=Path, metavar="FILE", help="4x4 in text, from the poses' frame to the map's; metres"
    )


def asked_source(path: Path, args: argparse.Namespace, *, scans_per_measurement: int | None = None) -> ScanSource:
    """The source that the options describe.

    Raises:
        BadInputError: options that do not fit it or each other, or as `open_source`.
    """
    # Bags and images need libraries that other commands of `cairn map` do without.
    from cairn_fusion.importers import open_source
    from cairn_fusion.ros.topic_mapping import mapping_next_to, mapping_of

    source = open_source(
        path,
        options=frame_options(args, path),
        mapping=mapping_of(args.topics) if args.topics else mapping_next_to(path),
        frames=args.frames,
        scans_per_measurement=scans_per_measurement,
        poses=pose_options(args),
        is_deskewed=args.deskewed,
    )
    return turned_source(source, up=args.up, T_map_world=args.T_map_world)


def add_frame_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options of a folder of frames."""
    group = command.add_argument_group("a folder of frames", TEXT)
    group.add_argument("--depth", metavar="PATTERN", help="16-bit PNG")
    group.add_argument("--colour", metavar="PATTERN", help="8-bit PNG or JPEG")
    group.add_argument("--thermal", metavar="PATTERN", help="16-bit PNG, linear in kelvin")
    group.add_argument("--pose", metavar="PATTERN", help="4x4 matrix in text")
    group.add_argument("--intrinsics", metavar="FILE|FX,FY,CX,CY", help="3x3 matrix in text, or four numbers, pixels")
    group.add_argument("--distortion", type=_numbers, metavar="K1,K2,P1,P2,K3", help="Brown's model (none)")
    group.add_argument("--depth-units", type=float, metavar="N", help="depth units in a metre (1000)")
    group.add_argument("--depth-convention", choices=[c.value for c in Convention], help="along z or the beam (z)")
    group.add_argument("--kelvin-per-count", type=float, metavar="K", help="scale of the thermal image (0.01)")
    group.add_argument("--kelvin-at-zero", type=float, metavar="K", help="offset of the thermal image (0)")
    group.add_argument("--frame-rate", type=float, metavar="HZ", help="frames in a second (1)")
    command.add_argument(
        "--frames",
        type=lambda text: text.split(","),
        metavar="ID,A-B,...",
        help="only these frames: ids, and ranges by number",
    )
    add_convention_arguments(command)


def frame_options(args: argparse.Namespace, folder: Path) -> FrameFolderOptions | None:
    """Options of a folder of frames as given, or None if there are none: then the folder's own layout counts.

    With intrinsics alone the patterns are found by the names of the folder's own folders.

    Raises:
        BadInputError: options that do not make a whole.
    """
    has_file = args.poses is not None
    if has_file and args.pose is not None:
        raise BadInputError("bad_option", "--pose and --poses are two sources of the same poses; give one of them")
    names = OPTIONS if has_file else (*OPTIONS, *OPTIONS_OF_PATTERN)
    given = {FIELD_OF_OPTION.get(name, name): getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.intrinsics is not None:
        given |= _intrinsics(args.intrinsics)
    if not given:
        return None
    if args.depth is None and args.intrinsics is not None and folder.is_dir():
        found = image_patterns(folder)
        given = found | given
        if found:
            say("images: " + ", ".join(f"{kind} {pattern}" for kind, pattern in sorted(found.items())))
    try:
        return FrameFolderOptions.model_validate(given)
    except ValidationError as exc:
        first = exc.errors()[0]
        where = f"--{first['loc'][0]}" if first["loc"] else "a folder of frames"
        what = "is missing" if first["type"] == "missing" else complaint_text(first["msg"])
        raise BadInputError("bad_option", f"{where}: {what}; see `cairn robot replay --help`") from exc


def _intrinsics(text: str) -> dict[str, object]:
    try:
        fx, fy, cx, cy = _numbers(text)
    except ValueError:
        return {"intrinsics_file": text}
    return {"focal_px": (fx, fy), "centre_px": (cx, cy)}


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))
