"""View agreement: poses that are right raise no doubt, and the usual mistakes do."""

from pathlib import Path

import numpy as np
import pytest

from cairn_calib.rig.camera import Camera
from cairn_calib.rig.image_files import write_grey16
from cairn_calib.rig.poses import inverse, look_at
from cairn_fusion.recording.frame_folder import FrameFolderOptions, import_frames
from cairn_fusion.recording.recording_format import Convention
from cairn_fusion.recording.view_agreement import pose_doubt

CAMERA = Camera(width=48, height=36, focal_px=(40.0, 40.0), centre_px=(23.5, 17.5))
LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([5.0, 4.0, 2.5])
OPTIONS = FrameFolderOptions(
    depth="{id}.png",
    pose="{id}.txt",
    focal_px=CAMERA.focal_px,
    centre_px=CAMERA.centre_px,
    depth_convention=Convention.RANGE,
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of an empty room, seen by a camera that walks and turns."""
    folder = tmp_path_factory.mktemp("room")
    for n in range(8):
        eye = np.array([1.5 + 0.15 * n, 1.2 + 0.05 * n, 1.1])
        T = look_at(eye, eye + np.array([np.cos(0.4 + 0.1 * n), np.sin(0.4 + 0.1 * n), -0.2]))
        rays = CAMERA.rays() @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            walls_m = np.where(rays > 0, (HIGH - eye) / rays, (LOW - eye) / rays)
        write_grey16(folder / f"{n}.png", np.rint(walls_m.min(axis=-1) * 1000).astype(np.uint16))
        np.savetxt(folder / f"{n}.txt", T, fmt="%.17g")
        np.savetxt(folder / f"{n}.inverse", inverse(T), fmt="%.17g")
    return folder


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, None),
        ({"pose": "{id}.inverse", "pose_convention": "map_to_camera"}, None),
        ({"pose": "{id}.inverse"}, "with the inverse poses"),
        ({"pose_convention": "map_to_camera"}, "with the inverse poses"),
        ({"axes": "opengl"}, "the axes of OpenGL against OpenCV"),
        ({"pose_convention": "map_to_camera", "axes": "opengl"}, "--pose-convention and --axes"),
        ({"pose": "3.txt"}, None),
    ],
)
def test_wrong_conventions_are_doubted_and_right_ones_are_not(
    changes: dict[str, str], words: str | None, room: Path
) -> None:
    doubt = pose_doubt(import_frames(room, FrameFolderOptions.model_validate(OPTIONS.model_dump() | changes)))
    assert (doubt is None) if words is None else (doubt is not None and words in doubt), doubt
