"""Layouts of recordings, detected by their files, and one function that opens any of them.

    open_source(path)  ->  detect_layout  ->  recording | apc_shelf | mm5 | bag | clouds

A bag is one of ROS, its topics named by a `BagMapping` or, where there is no doubt, by themselves. The other layouts
are presets of the generic folder of frames (`frame_folder.py`).
"""

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

from cairn_fusion.clouds.cloud_file import READERS, cloud_suffix
from cairn_fusion.clouds.cloud_folder import cloud_files, import_clouds
from cairn_fusion.recording.frame_folder import FrameFolderOptions, image_patterns, import_frames
from cairn_fusion.recording.frame_poses import PoseOptions
from cairn_fusion.recording.recording import Recording, ScanSource, open_recording
from cairn_fusion.recording.recording_format import HEADER_FILE, RIG_FILE
from cairn_fusion.ros.open_bag import SUFFIXES, is_bag
from cairn_fusion.ros.topic_mapping import BagMapping
from cairn_map.errors import BadInputError

APC_SHELF = FrameFolderOptions(
    name="apc_shelf",
    note="Amazon Picking Challenge shelf, RealSense F200 on an arm; frame times are made up.",
    depth="frames/frame-{id}.depth.png",
    colour="frames/frame-{id}.color.png",
    pose="frames/frame-{id}.pose.txt",
    intrinsics_file="K_color.txt",
    depth_units_per_m=10_000,
)
MM5 = FrameFolderOptions(
    name="mm5",
    note="MM5 rig A; frame times are made up. Temperature = counts / 64 kelvin is inferred, not documented: "
    "trust differences. Intrinsics and pose are estimates (focal length within 8 %).",
    depth="frames/A/{id}.depth.png",
    colour="frames/A/{id}.rgb.png",
    thermal="frames/A/{id}.thermal.png",
    pose="T_world_cam_A.txt",
    intrinsics_file="K_approx.txt",
    depth_units_per_m=1000,
    kelvin_per_count=1 / 64,
)


PACKET_SUFFIXES = (".pcap", ".pcapng", ".osf")
"""Suffixes of recorded network packets of lidars."""
INNER_FOLDERS_MAX = 100
"""Folders in a folder of no known layout that are looked into for clouds."""


def import_apc_shelf(folder: str | Path, *, scans_per_measurement: int = 1) -> Recording:
    """The Amazon Picking Challenge shelf: RGB-D from an arm, camera-to-world poses, z-depth in 0.1 mm."""
    return import_frames(folder, APC_SHELF, scans_per_measurement=scans_per_measurement)


def import_mm5(folder: str | Path, frames: Sequence[str] | None = None, *, scans_per_measurement: int = 1) -> Recording:
    """MM5, rig A: registered colour, depth and thermal from one pose; temperature scale inferred, see the note."""
    return import_frames(folder, MM5, frames=frames, scans_per_measurement=scans_per_measurement)


class SourceLayout(StrEnum):
    """Layouts that are detected by the files in them."""

    RECORDING = "recording"
    APC_SHELF = "apc_shelf"
    MM5 = "mm5"
    BAG = "bag"
    CLOUDS = "clouds"


LAYOUT_FILES: dict[SourceLayout, tuple[str, ...]] = {
    SourceLayout.RECORDING: (HEADER_FILE,),
    SourceLayout.APC_SHELF: ("K_color.txt", "frames"),
    SourceLayout.MM5: ("K_approx.txt", "T_world_cam_A.txt", "frames/A"),
}


def detect_layout(folder: str | Path) -> SourceLayout:
    """Layout of a folder.

    Raises:
        BadInputError: `unknown_layout`; the message lists what was looked for.
    """
    root = Path(folder)
    for layout, names in LAYOUT_FILES.items():
        if all((root / name).exists() for name in names):
            return layout
    if (root / RIG_FILE).exists():  # an unfinished recording; opening it says so
        return SourceLayout.RECORDING
    if is_bag(root):
        return SourceLayout.BAG
    if root.is_dir() and cloud_files(root):
        return SourceLayout.CLOUDS
    looked_for = "; ".join(f"{layout}: {' and '.join(names)}" for layout, names in LAYOUT_FILES.items())
    looked_for += f"; bag: {', '.join(SUFFIXES)}; clouds: {', '.join(READERS)}"
    if root.is_file() and root.suffix.lower() in PACKET_SUFFIXES:
        raise BadInputError(
            "unknown_layout",
            f"{root} holds raw packets of a lidar: make points of them first, with its maker's tools, and give the "
            "folder of clouds (Ouster: `ouster-cli source FILE save out.pcd`; Velodyne: velodyne-decoder)",
        )
    if root.is_file() and cloud_suffix(root) is not None:
        raise BadInputError(
            "unknown_layout", f"{root} is one cloud of points: give the folder it is in, {root.parent}, with --poses"
        )
    if root.is_file():
        raise BadInputError(
            "unknown_layout",
            f"{root} is a file that cannot be replayed: a bag of ROS ({', '.join(SUFFIXES)}) or a folder is expected; "
            f"looked for {looked_for}",
        )
    inner = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    if clouds := next((name for name in inner[:INNER_FOLDERS_MAX] if cloud_files(root / name)), None):
        raise BadInputError("unknown_layout", f"{root / clouds} holds clouds of points: give that folder, with --poses")
    if not root.is_dir():
        raise BadInputError("unknown_layout", f"there is no folder {root}, and no bag ({', '.join(SUFFIXES)})")
    if "depth" in (patterns := image_patterns(root)):
        raise BadInputError(
            "unknown_layout",
            f"{root} holds images ({', '.join(patterns.values())}) without intrinsics and poses: give --intrinsics "
            "FILE|FX,FY,CX,CY, and --pose PATTERN or --poses FILE",
        )
    raise BadInputError(
        "unknown_layout",
        f"{root} has none of the known layouts; looked for {looked_for}; or describe its frames with "
        "--depth, --pose and --intrinsics",
    )


def open_source(
    folder: str | Path,
    *,
    options: FrameFolderOptions | None = None,
    mapping: BagMapping | None = None,
    frames: Sequence[str] | None = None,
    scans_per_measurement: int | None = None,
    poses: PoseOptions | None = None,
    is_deskewed: bool = False,
) -> ScanSource:
    """A recording of any layout: by `options` or `mapping` if given, else by `detect_layout`; `poses` replace its own.

    `is_deskewed`: the points of clouds are those of one time already, whatever times they have.

    Raises:
        BadInputError: unknown layout, `frames` of a recording (its lists say which), `mapping` of what is no bag, or as
            the importer that fits.
    """
    layout = None if options else detect_layout(folder)
    if mapping is not None and layout is not SourceLayout.BAG:
        raise BadInputError("bad_mapping", f"{folder} is no bag, so topics cannot be named")
    preset = options or {SourceLayout.APC_SHELF: APC_SHELF, SourceLayout.MM5: MM5}.get(layout or SourceLayout.RECORDING)
    group = 1 if scans_per_measurement is None else scans_per_measurement
    if preset is not None:
        return import_frames(folder, preset, frames=frames, scans_per_measurement=group, poses=poses)
    if layout is SourceLayout.CLOUDS:
        return import_clouds(folder, poses=poses, frames=frames, scans_per_measurement=group, is_deskewed=is_deskewed)
    if frames is not None:
        raise BadInputError("unknown_frame", f"a {layout} has no frame ids to choose by")
    if layout is SourceLayout.BAG:
        from cairn_fusion.ros.bag_recording import open_any_bag

        return open_any_bag(
            Path(folder), mapping, scans_per_measurement=scans_per_measurement, poses=poses, is_deskewed=is_deskewed
        )
    return open_recording(folder, scans_per_measurement=scans_per_measurement, poses=poses)
