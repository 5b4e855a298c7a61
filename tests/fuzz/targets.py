"""Every decoder of bytes from outside, as a function of bytes: one line each in `TARGETS`.

A target may raise a `CairnError` with a short message, and nothing else; it may take neither much memory nor long.
What it does decode it puts through what everybody does with it: encoded anew it must say the same.
"""

import json
import random
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from tests.fuzz.begun_target import mutated_begun, read_begun
from tests.fuzz.cell_mutator import mutated_cell
from tests.fuzz.foreign_targets import mutated_message, read_bag, read_camera_file, read_ros_message
from tests.fuzz.json_mutator import mutated_json
from tests.fuzz.live_target import read_live
from tests.fuzz.message_target import check_properties, read_message
from tests.fuzz.png_mutator import mutated_png
from tests.fuzz.sections import in_folder, mutated_sections, sections_of
from tests.fuzz.wrapping_mutator import mutated_commit, mutated_reply

from cairn_calib.rig.rig import rig_from_json
from cairn_client.http.map_url import split_map_url
from cairn_fusion.importers import detect_layout
from cairn_fusion.recording.frame_folder import FrameFolderOptions, import_frames
from cairn_fusion.recording.images import image_header, read_colour, read_grey16
from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.trajectory import interpolate_pose, read_trajectory, trajectory_line
from cairn_map.codec.cell_code import Profile, decode_canonical_cell, decode_cell, encode_cell
from cairn_map.codec.cell_reading import cell_reader
from cairn_map.codec.view_code import decode_view
from cairn_map.commits.commit import commit_sha, renamed_commit, split_commit
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.commits.ids import author_from_text, commit_id_from_text, robot_name
from cairn_map.commits.signature import signatures_from_text, signatures_to_text
from cairn_map.commits.version_vector import version_vector_from_json
from cairn_map.errors import CairnError
from cairn_map.evidence.brick_cell import brick_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.fingerprint import fingerprint, fingerprint_from_hex
from cairn_map.evidence.grid import DEPTH_MAX, CellKey, Geometry, cell_from_text
from cairn_map.files.cell_folder import read_head
from cairn_map.wire.frames import FrameReader, encode_frame, frames_of, start_of_reply
from cairn_sim.scene.scene_file import load_scene

Mutate = Callable[[bytes], bytes]
"""Other bytes, of any length, that resemble those given."""

EVIDENCE_BYTES_MAX = 1 << 20
"""As a reader of strangers' cells sets it; more would only be slower."""
MESSAGE_LENGTH_MAX = 1000
"""Characters of an error that a person shall read."""
SCANS_MAX = 3
FRAMES = FrameFolderOptions(
    depth="frames/{id}.depth.png",
    colour="frames/{id}.colour.png",
    pose="frames/{id}.pose.txt",
    intrinsics_file="K.txt",
)


@dataclass(frozen=True, slots=True)
class Target:
    """A reader of bytes, and what makes other bytes that get past its checksums; None: libFuzzer alone."""

    read: Callable[[bytes], object]
    mutated: Callable[[bytes, random.Random, Mutate], bytes] | None = None


def survives(target: Target, data: bytes) -> bool:
    """Whether the bytes were taken; every error but ours goes through, and ours must be short."""
    try:
        target.read(data)
    except CairnError as exc:
        assert len(exc.message) <= MESSAGE_LENGTH_MAX, (
            f"a message of {len(exc.message)} characters: {exc.message[:200]}"
        )
        return False
    return True


def read_cell(data: bytes) -> None:
    """A cell of evidence; sound evidence has one canonical coding, and `decode_canonical_cell` takes only that."""
    cell = decode_cell(data, evidence_bytes_max=EVIDENCE_BYTES_MAX)
    check_evidence(cell.key, cell.evidence, cell.geometry)
    for profile in Profile:
        encoded = encode_cell(cell.key, cell.evidence, cell.geometry, profile=profile)
        again = decode_canonical_cell(encoded.data)
        assert (again.key, again.geometry, again.evidence) == (cell.key, cell.geometry, cell.evidence)
        assert again.digest == encoded.digest
    assert decode_canonical_cell(data, evidence_bytes_max=EVIDENCE_BYTES_MAX).digest == encoded.digest


def read_cell_partly(data: bytes) -> None:
    """A cell read as far as one asks: the octree to each depth, then channels from the last to the first."""
    for depth in range(1, DEPTH_MAX + 1):
        try:
            octree = cell_reader(data, evidence_bytes_max=EVIDENCE_BYTES_MAX).topology(depth)
        except CairnError:
            break
        assert len(octree.starts) == len(octree.sizes)
        assert int(octree.sizes.sum()) <= 8**DEPTH_MAX
    reader = cell_reader(data, evidence_bytes_max=EVIDENCE_BYTES_MAX)
    for c in reversed(range(len(reader.head.geometry.channels))):
        reader.channel(c)
    counts = reader.counts()
    assert counts.shape == (reader.head.leaves, 2)


def read_view(data: bytes) -> None:
    """A view: its rows name its nodes, and it reads as physical values."""
    view = decode_view(data, nodes_max=1 << 18).view
    assert (np.diff(view.nodes.astype(np.int64)) > 0).all()
    for rows, values in ((view.coloured, view.rgb), (view.scalar_rows, view.scalar_steps)):
        assert len(rows) == len(values)
        assert not len(rows) or int(rows[-1]) < len(view)
    assert ((view.probability >= 0) & (view.probability <= 1)).all()
    assert view.colour.shape == view.rgb.shape
    assert view.scalars.shape == view.scalar_steps.shape


def check_evidence(key: CellKey, evidence: Evidence, geometry: Geometry) -> None:
    """What everybody does with evidence, done."""
    fingerprint(evidence, key)
    assert brick_cell(geometry, [evidence]).packed() == evidence


def read_commit(data: bytes) -> None:
    """A commit: its parts are those that it was split into, and a renamed one opens too."""
    commit, cells = open_commit(data, evidence_bytes_max=EVIDENCE_BYTES_MAX)
    for key, cell in cells.items():
        check_evidence(key, cell.evidence, cell.geometry)
    meta, bodies = split_commit(data)
    assert (meta, bodies) == (commit.meta, commit.cells)
    digests = [cell.digest for cell in cells.values()]
    assert commit.sha == commit_sha(commit.text, digests, version=commit.meta.version)
    other = commit.id._replace(n=commit.id.n ^ 1)
    renamed = renamed_commit(data, commit=other, parent=None, retracts=())
    opened, _ = open_commit(renamed.data, evidence_bytes_max=EVIDENCE_BYTES_MAX)
    assert (opened.id, opened.sha, opened.cells) == (other, renamed.sha, commit.cells)


def read_reply(data: bytes) -> None:
    """A reply: in pieces it is the same, and encoded anew too."""
    frames = frames_of(data)
    pieces = FrameReader()
    written = start_of_reply() + b"".join(encode_frame(frame) for frame in frames)
    again = [frame for at in range(0, len(written), 97) for frame in pieces.feed(written[at : at + 97])]
    assert [encode_frame(frame) for frame in again] == [encode_frame(frame) for frame in frames]
    for frame in frames:
        check_properties(frame)


def read_version_vector(data: bytes) -> None:
    """A version vector in JSON, and its algebra."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # whoever calls has checked that it is JSON
        return
    vector = version_vector_from_json(value)
    assert version_vector_from_json(vector.to_json()) == vector
    assert len(vector.minus(vector)) == 0
    for author, spans in vector.intervals.items():
        assert vector.tip(author) == spans[-1][1]
    if len(vector) < 1000:
        commits = list(vector)
        assert type(vector)().with_commits(commits[::-1]) == vector
        half = type(vector)().with_commits(commits[::2])
        assert sorted(vector.minus(half)) == sorted(commits[1::2])


def read_text(data: bytes) -> None:
    """Each text form, by what it is said to be: it has one spelling only."""
    kind, _, rest = data.decode(errors="replace").partition(" ")
    parsers: dict[str, Callable[[str], object]] = {
        "cursor": cursor_from_text,
        "commit": commit_id_from_text,
        "author": author_from_text,
        "robot": robot_name,
        "cell": cell_from_text,
    }
    if kind == "signatures":
        assert signatures_to_text(signatures_from_text(rest)) == rest
    if kind in parsers:
        assert str(parsers[kind](rest)) == rest
    elif kind == "fingerprint":
        assert fingerprint_from_hex(rest).hex() == rest
    elif kind == "url":
        split_map_url(rest)


def read_rig(data: bytes) -> None:
    """A `rig.json`, and its cameras used: what projects goes back to where it came from, or is NaN."""
    rig = rig_from_json(data)
    assert rig_from_json(rig.to_json()).to_json() == rig.to_json()
    points = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-50.0, 3.0, 0.1], [0.0, 0.0, 0.0], [1.0, 2.0, -3.0]])
    with np.errstate(all="ignore"):
        for mounted in rig.cameras.values():
            camera = mounted.camera
            rays = camera.unproject(camera.project(points))
            assert rays.shape == points.shape
            assert mounted.transform.shape == (4, 4)


def read_map_head(data: bytes) -> None:
    """A `map.json`."""
    with in_folder([("map.json", data)]) as folder:
        read_head(folder)


def read_recording(data: bytes) -> None:
    """A recording: `=== file`, then what is in it."""
    with in_folder(sections_of(data)) as folder, np.errstate(all="ignore"):
        detect_layout(folder)
        recording = open_recording(folder)
        assert sum(len(stop) for stop in recording.measurements()) == len(recording)
        for index in range(min(len(recording), SCANS_MAX)):
            recording.scan(index)


def read_frame_folder(data: bytes) -> None:
    """A foreign folder of frames: matrices in text, images."""
    with in_folder(sections_of(data)) as folder, np.errstate(all="ignore"):
        recording = import_frames(folder, FRAMES)
        for index in range(min(len(recording), SCANS_MAX)):
            recording.scan(index)


def read_trajectory_text(data: bytes) -> None:
    """A `trajectory.txt`, its poses between two lines, and its lines written again."""
    with in_folder([("trajectory.txt", data)]) as folder:
        poses = read_trajectory(folder / "trajectory.txt").poses
    with np.errstate(all="ignore"):
        for start, end in zip(poses.values[:20], poses.values[1:21], strict=False):
            assert interpolate_pose(start, end, 0.5).shape == (4, 4)
        for time_s, T_map_rig in zip(poses.times_s.tolist()[:20], poses.values, strict=False):
            trajectory_line(time_s, T_map_rig)


def read_image(data: bytes) -> None:
    """An image file, in both ways that it is read."""
    with in_folder([("image", data)]) as folder:
        header = image_header(folder / "image")
        for read in (read_colour, read_grey16):
            try:
                assert read(folder / "image").shape[:2] == (header.height, header.width)
            except CairnError:
                continue


def read_scene(data: bytes) -> None:
    """A scene file."""
    with in_folder([("scene.toml", data)]) as folder:
        load_scene(folder / "scene.toml")


TARGETS: dict[str, Target] = {
    "cell": Target(read_cell, mutated_cell),
    "cell-part": Target(read_cell_partly, mutated_cell),
    "view": Target(read_view),
    "commit": Target(read_commit, mutated_commit),
    "reply": Target(read_reply, mutated_reply),
    "message": Target(read_message, mutated_sections),
    "version-vector": Target(read_version_vector, mutated_json),
    "text": Target(read_text),
    "rig": Target(read_rig, mutated_json),
    "map-head": Target(read_map_head, mutated_json),
    "recording": Target(read_recording, mutated_sections),
    "frame-folder": Target(read_frame_folder, mutated_sections),
    "trajectory": Target(read_trajectory_text),
    "image": Target(read_image, mutated_png),
    "scene": Target(read_scene),
    "begun": Target(read_begun, mutated_begun),
    "bag": Target(read_bag, mutated_sections),
    "ros-message": Target(read_ros_message, mutated_message),
    "camera-file": Target(read_camera_file, mutated_sections),
    "live": Target(read_live, mutated_sections),
}
