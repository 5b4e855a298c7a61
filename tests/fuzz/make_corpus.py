"""Inputs that fuzzing starts from: small real encodings, one for each thing that a format can say.

    python -m tests.fuzz.make_corpus

writes those that are missing, never over one that is there. Besides these, `corpus` holds every input that ever was a
finding: each is read again by an ordinary test.
"""

import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel
from tests.fixtures.map.made import GEOMETRIES, KEY, MIDDLE, PLAIN, ROBOT, SMALL, made_commit, made_cursor, made_frames
from tests.fixtures.map.made import random_evidence as made_evidence
from tests.fixtures.map.stored import recoded
from tests.formats.make_formats import mark_commit_bytes
from tests.fuzz.foreign_corpus import foreign_seeds
from tests.fuzz.sections import joined

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.lidar import SpinningLidar
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.recording.recording_writer import RecordingWriter
from cairn_fusion.recording.scan import Scan
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_map.codec.cell_code import Profile, encode_cell
from cairn_map.codec.view_code import encode_view
from cairn_map.commits.signature import Signature, signatures_to_text
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.fingerprint import ZERO, fingerprint
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.evidence.view import Chance, Extent, ViewStyle
from cairn_map.files.cell_folder import FolderHead
from cairn_map.wire.frames import CellFrame, FrameKind, encode_frame, start_of_reply
from cairn_map.wire.messages import (
    CellCursor,
    CellEntry,
    CellIndex,
    CreateMap,
    Done,
    LogEntry,
    MapInfo,
    MissingRequest,
    More,
    Problem,
    PushReceipt,
    Register,
    ReplyHeader,
    Retract,
)

CORPUS = Path(__file__).parent / "corpus"
SUFFIX = ".input"
TOF = camera_from_field_of_view(8, 6, horizontal_deg=60.0)
RIG = Rig(
    name="head",
    cameras={
        "tof": mount_camera(Spectrum.RANGE, TOF, np.eye(4)),
        "left": mount_camera(
            Spectrum.COLOUR, TOF.model_copy(update={"distortion": (-0.2, 0.05, 1e-3, -1e-3, 0.01)}), np.eye(4)
        ),
        "warm": mount_camera(Spectrum.THERMAL, TOF, np.eye(4)),
    },
)
LIDAR = Rig(
    name="drum",
    cameras={
        "lidar": mount_camera(
            Spectrum.RANGE, SpinningLidar(width=16, height=3, elevations_deg=(10.0, 0.0, -30.0)), np.eye(4)
        )
    },
)
SCENE = """format = "cairn-scene"
version = 1
name = "office"
sky_c = -10.0
[materials]
tile = {colour = "#968c7d", emissivity = 0.95, nir = 0.45, gloss = 0.1}
grout = {colour = "#69645f", temperature_c = 18.0, retroreflection = 3.0}
pane = {colour = "#d0e0e0", temperature_c = 3.0, optics = "glass"}
[surfaces]
tiles = {material = "tile", second = "grout", period_m = [0.5, inf], phase_m = [0, 0], grain = 0.1, grain_m = 0.05}
[objects.stool]
parts = [
  {name = "seat", box = [0.4, 0.4, 0.04], at = [0, 0, 0.46], surface = "tile"},
  {name = "leg", cylinder = [0.03, 0.46], surface = "pane"},
]
[areas.hall]
solids = [
  {name = "floor", from = [0, 0, -0.2], to = [6, 5, 0], surface = "tiles"},
  {name = "ball", sphere = 0.3, at = [1, 1, 1], surface = "tile", temperature_c = 60.0},
  {name = "earth", plane = true, turn_deg = [0, 10, 0], surface = "tile"},
]
places = [
  {object = "stool", name = "stool", at = [1, 2, 0], turn_deg = 30, surfaces = {tile = "pane"}},
  {object = "stool", name = "row", at = [3, 1, 0], count = 2, step_m = [1, 0, 0]},
]
"""
MOVING = """[[moving]]
name = "cart"
object = "stool"
at = [1, 1, 0]
keyframes = [{time_s = 0, gone = true}, {time_s = 5, at = [1, 0, 0], turn_deg = 30}, {time_s = 10.5}]
repeat_s = 20
"""
BASED = """format = "cairn-scene"
version = 1
name = "mine"
base = "moving-yard"
without = ["shed", "car"]
sky = "#102030"
"""


def seeds() -> Iterator[tuple[str, str, bytes]]:
    """Target, name and bytes of each."""
    yield from _cells()
    yield "commit", "two-cells", made_commit().data
    yield "commit", "marks", mark_commit_bytes()
    yield "commit", "retract", made_commit(retracts=(f"{ROBOT}.7",), note="größer", seen=str(made_cursor())).data
    for n, frame in enumerate(made_frames()):
        yield "reply", f"frame-{n}", start_of_reply() + encode_frame(frame)
    yield "reply", "whole", start_of_reply() + b"".join(encode_frame(frame) for frame in made_frames())
    for model in _messages():
        name = type(model).__name__
        yield "message", name, joined([(name, model.model_dump_json(exclude_none=True).encode())])
    yield "version-vector", "gaps", json.dumps({ROBOT: [[0, 4], [6, 9]], "a.0000000000000000": [[3, 3]]}).encode()
    yield from _texts()
    yield "rig", "three-cameras", RIG.to_json()
    yield "rig", "lidar", LIDAR.to_json()
    yield "map-head", "standard", FolderHead(geometry=SMALL).model_dump_json().encode()
    yield "scene", "office", SCENE.encode()
    yield "scene", "moving", (SCENE + MOVING).encode()
    yield "scene", "based", BASED.encode()
    poses = [(0.0, np.eye(4)), (0.5, np.diag([1.0, -1.0, -1.0, 1.0]))]
    yield "trajectory", "two-poses", b"# made\n" + b"".join(trajectory_line(*pose).encode() for pose in poses)
    yield "recording", "two-scans", _recording()
    yield from _images()
    yield "frame-folder", "one-frame", _frame_folder()
    yield from _begun()
    yield from foreign_seeds()


def _cells() -> Iterator[tuple[str, str, bytes]]:
    for n, geometry in enumerate(GEOMETRIES):
        evidence = made_evidence(n, geometry, voxels=12, air=0 if geometry.depth > 3 else 2)
        data = encode_cell(KEY, evidence, geometry).data
        yield "cell", f"geometry-{n}", data
        small = encode_cell(KEY, evidence, geometry, profile=Profile.SMALL).data
        yield "cell", f"geometry-{n}-plain", recoded(data, level=None)
        yield "cell", f"geometry-{n}-small", small
        yield "cell-part", f"geometry-{n}", data
        yield "cell-part", f"geometry-{n}-small", small
        for extent, chance in zip(Extent, Chance, strict=True):
            style = ViewStyle(depth=3, extent=extent, chance=chance)
            yield "view", f"geometry-{n}-{extent}", encode_view(KEY, evidence, geometry, SensorModel(), style=style)
    evidence = made_evidence(0, SMALL, voxels=8, air=1)
    signed = Evidence(evidence.voxels, -evidence.counts, evidence.sampled, -evidence.samples)
    yield "cell", "signed", encode_cell(KEY, signed, SMALL).data
    yield "cell", "empty", encode_cell(KEY, empty_evidence(PLAIN), PLAIN).data


def _messages() -> list[BaseModel]:
    to, sha = str(made_cursor()), "ef" * 32
    rest = fingerprint(empty_evidence(SMALL), KEY).hex()
    header = ReplyHeader(to=to, vector={ROBOT: [[0, 4]]}, stable={ROBOT: [[0, 3]]}, tip=(7, sha))
    box = ((0.0, 0.0, 0.0), (5.12, 5.12, 5.12))
    entry = CellEntry(cell=(1, -2, 3), size_bytes=500, digest=sha, lm=4, fingerprint=rest, voxels=12)
    return [
        CreateMap(geometry=SMALL),
        MapInfo(
            name="lab", geometry=PLAIN, sensor_model=SensorModel(), cursor=to, cells=1, size_bytes=500, commits=2,
            branches=1, box_m=box,
        ),
        Register(robot="mole", incarnation="0123456789abcdef", sensors=["tof"]),
        PushReceipt(id=f"{ROBOT}.3", state="new"),
        MissingRequest(author=ROBOT, cursor=to, cells=[CellCursor(cell=(1, 2, -3), cursor=to)], kinds=["delta"]),
        header,
        Done(to=to, rest=rest),
        More(to=to),
        CellIndex(header=header, cells=[entry]),
        Retract(commits=[f"{ROBOT}.3"], robot="mole", note="wrong"),
        LogEntry(
            seq=1, kind="+", id=f"{ROBOT}.3", sha=sha, size_bytes=9, cells=1, captured_s=(1.0, 2.0), retracts=[]
        ),
        Problem(title="gone", status=404, kind="no_map"),
    ]  # fmt: skip


def _texts() -> Iterator[tuple[str, str, bytes]]:
    texts = {
        "cursor": str(made_cursor()),
        "commit": f"{ROBOT}.12",
        "author": ROBOT,
        "robot": "mole-2",
        "cell": "0,-12,3",
        "fingerprint": "0f" * 16,
        "url": "http://base:8750/maps/lab",
        "signatures": signatures_to_text([Signature(bytes(range(32)), bytes(64))] * 2),
    }
    for kind, text in texts.items():
        yield "text", kind, f"{kind} {text}".encode()


def _recording() -> bytes:
    shape = TOF.height, TOF.width
    range_m = np.linspace(0.5, 3, shape[0] * shape[1], dtype=np.float32).reshape(shape)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "made"
        with RecordingWriter(folder, RIG, name="made") as recording:
            for n in range(2):
                scan = Scan(
                    time_s=float(n),
                    T_map_rig=np.eye(4),
                    range_camera="tof",
                    range_m=range_m,
                    amplitude=np.full(shape, 300 + n, np.uint16),
                    colour={"left": np.full((*shape, 3), 40 * n, np.uint8)},
                    thermal={"warm": np.full(shape, 293.0, np.float32)},
                    scalars={"dose": 0.1},
                )
                recording.add(scan)
            recording.end_measurement()
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        short = {path: path.relative_to(folder).as_posix().replace("images/", "i").replace("/", "-") for path in files}
        lists = {path: path.read_bytes() for path in files}
        for path, data in lists.items():
            for other in files:
                if path.suffix == ".txt":
                    data = data.replace(other.relative_to(folder).as_posix().encode(), short[other].encode())
            lists[path] = data
        return joined([(short[path], data) for path, data in lists.items()])


def _begun() -> Iterator[tuple[str, str, bytes]]:
    """A cell of some kilobytes, cut after a few hundred bytes of it."""
    body = encode_cell(KEY, made_evidence(1, MIDDLE, voxels=2000, air=0), MIDDLE).data
    cell = CellFrame(
        kind=FrameKind.FULL, cell=KEY, from_cursor=None, to_cursor=made_cursor(), fingerprint=ZERO, payload=body
    )
    others = [frame for frame in made_frames() if not isinstance(frame, CellFrame)]
    whole = start_of_reply() + b"".join(encode_frame(frame) for frame in (*others[:1], cell, *others[-1:]))
    yield "begun", "same-again", joined([("first", whole[:2000]), ("then", whole)])
    yield "begun", "nothing-new", joined([("first", start_of_reply()), ("then", whole)])
    rest = encode_frame(replace(cell, continues=True, payload=body[700:]))
    yield "begun", "goes-on", joined([("first", whole[:2000]), ("then", start_of_reply() + rest)])


def _images() -> Iterator[tuple[str, str, bytes]]:
    counts = np.arange(48, dtype=np.uint16).reshape(6, 8) * 100
    colour = np.zeros((6, 8, 3), np.uint8)
    colour[2:4] = 200
    for name, suffix, image in (("grey16", ".png", counts), ("colour", ".png", colour), ("jpeg", ".jpg", colour)):
        yield "image", name, _encoded(suffix, image)


def _frame_folder() -> bytes:
    counts = np.full((6, 8), 1500, np.uint16)
    return joined(
        [
            ("K.txt", b"7 0 3.5\n0 7 2.5\n0 0 1\n"),
            ("frames/0.pose.txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0.5\n0 0 0 1\n"),
            ("frames/0.depth.png", _encoded(".png", counts)),
            ("frames/0.colour.png", _encoded(".png", np.zeros((6, 8, 3), np.uint8))),
        ]
    )


def _encoded(suffix: str, image: np.ndarray) -> bytes:
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data)


def main() -> None:
    """Write what is missing."""
    for target, name, data in seeds():
        path = CORPUS / target / (name + SUFFIX)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_bytes(data)


if __name__ == "__main__":
    main()
