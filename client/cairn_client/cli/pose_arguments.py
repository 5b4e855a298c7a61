"""Command-line options for poses of any published form: the file, its conventions, and bounds."""

import argparse
from pathlib import Path

from pydantic import ValidationError

from cairn_fusion.recording.frame_poses import AXES_TEXT, MAX_GAP_S, PoseOptions
from cairn_fusion.recording.pose_files import UNITS_PER_S, Axes, PoseConvention
from cairn_map.errors import BadInputError, first_error

TEXT = """--poses FILE replaces a source's own poses; its form is recognised by its content:
KITTI poses.txt (12 numbers a line, by frame number), TUM (time tx ty tz qx qy qz qw), EuRoC's csv (poses of a body:
--T-body-sensor), nerfstudio's transforms.json (OpenGL axes, by image name), COLMAP's images.txt (map to camera, by
image name), or a folder of 4x4 matrices, one text file a frame. Times are matched by interpolation. Without metric
scale (nerfstudio, COLMAP) --scale is needed. What was read, under which conventions, is printed."""
TRAJECTORY_TEXT = """--trajectory FILE has poses by time, in a form recognised by its content: TUM (time tx ty tz qx
qy qz qw) or EuRoC's csv (poses of a body: --T-body-sensor). They are of the rig, or of the camera that --poses-of
names. Times are matched by interpolation."""
FIELD_OF_OPTION = {
    "poses": "path",
    "pose_convention": "convention",
    "axes": "axes",
    "pose_scale": "scale",
    "T_body_sensor": "T_body_sensor",
    "poses_of": "of",
    "pose_time_unit": "time_unit",
    "max_pose_gap": "max_gap_s",
    "first_frame": "first_frame",
    "max_pose_jump": "max_jump_m",
}
OF_PATTERNS = ("pose_convention", "axes")
"""Options that count for `--pose PATTERN` as well."""


def add_pose_arguments(command: argparse.ArgumentParser, *, scale: tuple[str, ...]) -> None:
    """Add the options, but for those that `add_convention_arguments` adds; `scale` are the names of one of them."""
    group = command.add_argument_group("poses of a published form", TEXT)
    group.add_argument("--poses", type=Path, metavar="FILE", help="pose file, or folder of matrices")
    _add_reading(group, scale=scale)


def add_trajectory_arguments(command: argparse.ArgumentParser) -> None:
    """Add `--trajectory FILE` in the place of `--poses`, and all options that say how it is read."""
    group = command.add_argument_group("the trajectory", TRAJECTORY_TEXT)
    group.add_argument("--trajectory", dest="poses", required=True, type=Path, metavar="FILE", help="the new poses")
    _add_reading(group, scale=("--scale",))
    add_convention_arguments(command)


def _add_reading(group: "argparse._ArgumentGroup", *, scale: tuple[str, ...]) -> None:
    group.add_argument(
        *scale, dest="pose_scale", type=float, metavar="METRES_PER_UNIT", help="length of one unit of the positions"
    )
    group.add_argument("--T-body-sensor", type=Path, metavar="FILE", help="sensor.yaml with T_BS, or 4x4 in text")
    group.add_argument("--poses-of", metavar="CAMERA|rig", help="camera of the rig that the poses are of")
    group.add_argument("--pose-time-unit", choices=list(UNITS_PER_S), help="unit of its times (s; EuRoC: ns)")
    group.add_argument(
        "--max-pose-gap", type=float, metavar="S", help=f"interpolate between poses so far apart ({MAX_GAP_S:g})"
    )
    group.add_argument("--first-frame", type=int, metavar="N", help="frame of the first line of KITTI's form (0)")
    group.add_argument("--max-pose-jump", type=float, metavar="METRES", help="largest step between poses (10)")
    group.add_argument(
        "--skip-bad", action="store_true", help="leave out bad poses, and frames without one; count them"
    )


def add_convention_arguments(command: argparse.ArgumentParser) -> None:
    """Add the conventions of poses, which count for a pose file and for `--pose PATTERN`."""
    group = command.add_argument_group("conventions of poses")
    axes = "; ".join(f"{name}: {text}" for name, text in AXES_TEXT.items())
    group.add_argument(
        "--pose-convention",
        choices=[c.value for c in PoseConvention],
        help="direction in which a pose maps points (the form's; camera_to_map)",
    )
    group.add_argument("--axes", choices=[a.value for a in Axes], help=f"axes of the posed camera ({axes})")


def pose_options(args: argparse.Namespace) -> PoseOptions | None:
    """The pose file and its conventions, or None without `--poses`.

    Raises:
        BadInputError: options of a pose file without one, or an option that is wrong.
    """
    given = {name: getattr(args, name) for name in FIELD_OF_OPTION if getattr(args, name) is not None}
    if args.poses is None:
        lone = [name for name in given if name not in OF_PATTERNS] + ["skip_bad"] * args.skip_bad
        if lone:
            name = "scale" if lone[0] == "pose_scale" else lone[0].replace("_", "-")
            raise BadInputError("bad_option", f"--{name} is about a pose file: give --poses FILE")
        return None
    try:
        fields = {FIELD_OF_OPTION[name]: value for name, value in given.items()}
        return PoseOptions.model_validate({**fields, "skip_bad": args.skip_bad})
    except ValidationError as exc:
        raise BadInputError("bad_option", f"options of --poses: {first_error(exc)}") from exc
