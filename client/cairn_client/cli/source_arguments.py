"""Command-line options that say what a source of scans is: shared by all commands that read recordings."""

import argparse
from pathlib import Path

from cairn_client.cli.frame_arguments import add_frame_arguments, frame_options
from cairn_client.cli.pose_arguments import add_pose_arguments, pose_options
from cairn_fusion.recording.recording import ScanSource
from cairn_fusion.recording.turned_source import AXES_UP, turned_source


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
