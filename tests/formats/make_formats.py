"""Stored bytes of format versions 1 to 4: made once, kept for ever.

    python -m tests.formats.make_formats

writes the files that are missing, never over one that is there: if the code writes other bytes today, the old ones
must still decode. What they decode to is in the JSON files. `before-epochs.*.zst` are a store, a backup and a
robot's folder of the last version without epochs.
"""

import json
from pathlib import Path

import numpy as np
from tests.naive.evidence import interleave

from cairn_map.codec.cell_code import Profile, decode_cell, encode_cell
from cairn_map.codec.history_code import decode_history, encode_history
from cairn_map.commits.attachment import attachment_of
from cairn_map.commits.commit import CommitMeta, ScanPose, make_commit
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.cursor import Cursor
from cairn_map.commits.mark import make_mark
from cairn_map.epochs.cell_history import CellHistory, cell_history, history_fingerprint
from cairn_map.epochs.epoch import BASE, Epoch
from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.evidence.channels import (
    COLOUR,
    HEIGHT_OFFSET,
    INTENSITY,
    TEMPERATURE,
    Channel,
    ChannelKind,
    classes_channel,
)
from cairn_map.evidence.evidence import Evidence, empty_evidence, packed_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.wire.frames import CellFrame, FrameKind, encode_frame, frames_of, start_of_reply
from cairn_map.wire.messages import Done, More, ReplyHeader

CELLS = ("v1-all-channels.cell", "v1-signed.cell", "v1-empty.cell", "v1-small.cell")

CLASS_CELL = "v1-classes.cell"

EPOCH_CELLS = ("v2-fast.cell", "v2-small.cell")

LAYER_CELLS = ("v1-level.cell", "v1-level-small.cell", "v1-classes-small.cell")
"""Cells of the kinds that layers brought: flat voxels, and votes for classes."""
LAYER_EPOCH_CELLS = ("v2-level.cell", "v2-classes.cell")

FOLDER = Path(__file__).parent
DOSE = Channel(kind=ChannelKind.SCALAR, name="dose", unit="µSv/h", step=0.01, zero=-1.5)
SCALARS = tuple(Channel(kind=ChannelKind.SCALAR, name=name, unit="u", step=1.0) for name in ("a", "b"))
GEOMETRY = Geometry(voxel_edge_um=40_000, depth=4, channels=(COLOUR, INTENSITY, TEMPERATURE, DOSE))
CLASSED = Geometry(voxel_edge_um=50_000, depth=4, channels=(classes_channel(("wall", "floor", "chair")),))
LEVEL = Geometry(voxel_edge_um=200_000, height_step_um=50_000, depth=4, channels=(HEIGHT_OFFSET,))
LAYER = MapLayer(geometry=GEOMETRY, epoch_s=120)
GROUND, THINGS = (MapLayer(geometry=each, epoch_s=120) for each in (LEVEL, CLASSED))
KEY = cell_key((-3, 2, 0))
AUTHOR = "mole.0123456789abcdef"


def evidence(sign: int = 1) -> Evidence:
    """A floor with all channels, air above it."""
    floor = np.arange(0, 4096, 37)
    air = np.setdiff1d(np.arange(2048, 3072), floor)
    places = np.concatenate([floor, air])
    counts = np.where(np.arange(len(places))[:, None] < len(floor), [[3, 1]], [[0, 2]])
    samples = np.zeros((len(places), GEOMETRY.plane_count), np.int64)
    n = np.arange(len(floor))
    w = 1 + n % 3
    value = 5800 + n
    samples[: len(floor)] = np.stack(
        [n * w, 200 * w, (255 - n) * w, w, 90 * w + n, w, value * w, value**2 * w + n, w, n * w, w], axis=1
    )
    return packed_evidence(places.astype(np.uint32), sign * counts, sign * samples, GEOMETRY)


def wall() -> Evidence:
    """A tilted wall with all channels, seen-through air before it: what models pay for."""
    x, y, z = np.indices((16, 16, 16)).reshape(3, -1)
    surface = 8 + (2 * x + y) // 12
    noise = (x * 73 + y * 151 + z * 283) % 7
    hit = (z == surface) & (noise > 0)
    there = (z < surface) | hit
    x, y, z, noise, hit = x[there], y[there], z[there], noise[there], hit[there]
    counts = np.where(hit[:, None], np.stack([2 + noise // 2, noise % 2], axis=1), [[0, 3]])
    w = np.where(hit & (y < 14), 1 + noise // 3, 0)
    value = 5800 + 3 * x + y + noise
    red, green, blue = 100 + 4 * x + noise, 80 + 3 * y, 200 - 5 * x
    samples = np.stack(
        [red * w, green * w, blue * w, w, (90 + noise) * w, w, value * w, value**2 * w + noise * w, w, x * w, w], axis=1
    )
    places = [interleave(*voxel) for voxel in zip(x.tolist(), y.tolist(), z.tolist(), strict=True)]
    return packed_evidence(np.array(places, np.uint32), counts, samples, GEOMETRY)


def classes() -> Evidence:
    """Votes for four classes on a floor, some for two of them, some for `other` alone."""
    places = np.arange(0, 4096, 41)
    n = np.arange(len(places))
    first, second = np.where(n % 3, 1 + n % 4, 0), np.where(n % 5, 0, 300)
    samples = np.stack([first, second, 0 * n, first + second + n % 2], axis=1)
    return packed_evidence(places.astype(np.uint32), np.ones((len(places), 2), np.int32), samples, CLASSED)


def ground() -> Evidence:
    """Votes for the heights of a slope with a bridge above it, and bins that beams crossed."""
    x, y, z = np.indices((16, 16, 16)).reshape(3, -1)
    slope, bridge = z == (x + 2 * y) // 8, (z == 13) & (x > 9)
    n = x * 7 + y * 3 + z
    crossed = (z == (x + 2 * y) // 8 + 1) & (n % 4 == 0)
    there, voted = slope | bridge | crossed, slope | (bridge & (y < 14))
    w = np.where(voted, 1 + n % 3, 0)
    counts = np.stack([np.where(slope | bridge, w + n % 2, 0), np.where(crossed, 1 + n % 5, 0)], axis=1)
    samples = np.stack([w * (n % 10), w], axis=1)
    voxels = zip(x[there].tolist(), y[there].tolist(), z[there].tolist(), strict=True)
    places = np.array([interleave(*voxel) for voxel in voxels], np.uint32)
    return packed_evidence(places, counts[there], samples[there], LEVEL)


def layer_evidence() -> dict[str, tuple[Evidence, Geometry]]:
    """Content of each of `LAYER_CELLS`."""
    return dict(zip(LAYER_CELLS, ((ground(), LEVEL), (ground(), LEVEL), (classes(), CLASSED)), strict=True))


def layer_histories() -> dict[str, tuple[CellHistory, MapLayer]]:
    """Content of each of `LAYER_EPOCH_CELLS`."""
    found = {}
    for name, evidence, layer in zip(LAYER_EPOCH_CELLS, (ground(), classes()), (GROUND, THINGS), strict=True):
        found[name] = cell_history({BASE: evidence, Epoch(14_500_000): evidence}), layer
    return found


def commit_bytes() -> bytes:
    """An amend: evidence, and a retracted commit."""
    pose = ScanPose(time_s=1.5e9, t_map_rig=(1.0, -2.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0), sigma_m=0.01)
    meta = CommitMeta(
        id=f"{AUTHOR}.7",
        geometry=GEOMETRY.digest().hex(),
        parent="ab" * 32,
        seen=str(cursor(5)),
        captured_s=(1.5e9, 1.5e9 + 30),
        scans=(pose,),
        sensors=("tof", "ccd"),
        rig="cd" * 32,
        integrator="cairn 0.1",
        retracts=(f"{AUTHOR}.6",),
        note="größer",
    )
    return make_commit(meta, {KEY: evidence(), cell_key((0, 0, 0)): evidence()}, GEOMETRY).data


def history() -> CellHistory:
    """The base and two epochs, one of them before 1970."""
    return cell_history({BASE: evidence(), Epoch(-3): wall(), Epoch(14_500_000): evidence()})


def epoch_commit_bytes() -> bytes:
    """A commit of one epoch."""
    meta = CommitMeta(id=f"{AUTHOR}.8", layers=LAYER.identities, epoch=14_500_000, captured_s=(1.74e9, 1.74e9 + 30))
    return make_commit(meta, {KEY: evidence(), cell_key((0, 0, 0)): wall()}, LAYER).data


def mark_commit_bytes() -> bytes:
    """A commit with two marks that takes the place of another one."""
    lamp = make_mark(kind="hot_spot", name="Lampe größer", at_m=(1.25, -2.0, 0.4), time_s=1.5e9, note="two\nlines")
    door = make_mark(kind="door", name="door", at_m=(0.0, 0.0, 1.0), extent_m=(0.9, 0.1, 2.0), time_s=1.5e9, by="ada")
    meta = CommitMeta(
        id=f"{AUTHOR}.9", geometry=GEOMETRY.digest().hex(), retracts=(f"{AUTHOR}.5",), marks=(lamp, door), note="n"
    )
    return make_commit(meta, {}, GEOMETRY).data


def layer_commit_bytes() -> bytes:
    """A commit that defines a layer, whose depth is not the one that a reader would take."""
    fine = Geometry(voxel_edge_um=10_000, depth=7, channels=(*GEOMETRY.channels, *SCALARS))
    layer = LayerDefinition(name="fine_1", geometry=fine, epoch_s=60)
    meta = CommitMeta(id=f"{AUTHOR}.10", geometry=GEOMETRY.digest().hex(), layer=layer, note="n")
    return make_commit(meta, {}, GEOMETRY).data


def attachment_commit_bytes() -> bytes:
    """A commit with a mark that names an attachment."""
    lamp = make_mark(
        kind="hot_spot", name="lamp", at_m=(1.25, -2.0, 0.4), time_s=1.5e9, attachment=attachment_of(b"a picture")
    )
    meta = CommitMeta(id=f"{AUTHOR}.10", geometry=GEOMETRY.digest().hex(), marks=(lamp,))
    return make_commit(meta, {}, GEOMETRY).data


def cursor(seq: int) -> Cursor:
    """A made-up place in a made-up log."""
    return Cursor(bytes(range(16)), seq, bytes(range(16, 32)))


def reply_bytes() -> bytes:
    """A frame of every kind."""
    cell, sums = encode_cell(KEY, evidence(), GEOMETRY).data, fingerprint(evidence(), KEY)
    signed = encode_cell(KEY, evidence(-1), GEOMETRY).data
    common = {"cell": KEY, "to_cursor": cursor(9), "fingerprint": sums}
    to = str(cursor(9))
    frames = [
        ReplyHeader(to=to, vector={AUTHOR: [[0, 4], [6, 7]]}, stable={AUTHOR: [[0, 3]]}, tip=(7, "ef" * 32)),
        CellFrame(kind=FrameKind.DELTA, from_cursor=cursor(5), payload=signed, own_excluded=True, **common),
        CellFrame(
            kind=FrameKind.STATE, from_cursor=cursor(5), payload=cell, blocks=np.arange(64, dtype=np.uint32), **common
        ),
        CellFrame(kind=FrameKind.FULL, from_cursor=None, payload=cell, **common),
        CellFrame(kind=FrameKind.RESET, from_cursor=cursor(5), **common),
        More(to=to),
        Done(to=to, rest=sums.hex()),
    ]
    return start_of_reply() + b"".join(encode_frame(frame) for frame in frames)


def made() -> dict[str, bytes]:
    """Name of each file, and its bytes as the code of today writes them."""
    return {
        "v1-all-channels.cell": encode_cell(KEY, evidence(), GEOMETRY).data,
        "v1-small.cell": encode_cell(KEY, wall(), GEOMETRY, profile=Profile.SMALL).data,
        "v1-signed.cell": encode_cell(KEY, evidence(-1), GEOMETRY).data,
        "v1-empty.cell": encode_cell(KEY, empty_evidence(GEOMETRY), GEOMETRY).data,
        CLASS_CELL: encode_cell(KEY, classes(), CLASSED).data,
        **{
            name: encode_cell(KEY, *content, profile=Profile.SMALL if "small" in name else Profile.FAST).data
            for name, content in layer_evidence().items()
        },
        **{name: encode_history(KEY, *content).data for name, content in layer_histories().items()},
        "v1.commit": commit_bytes(),
        "v1.reply": reply_bytes(),
        "v2-fast.cell": encode_history(KEY, history(), LAYER).data,
        "v2-small.cell": encode_history(KEY, history(), LAYER, profile=Profile.SMALL).data,
        "v2.commit": epoch_commit_bytes(),
        "v3.commit": mark_commit_bytes(),
        "v4.commit": layer_commit_bytes(),
        "v3-attachment.commit": attachment_commit_bytes(),
    }


def found() -> dict[str, object]:
    """What the stored bytes say today."""
    cells = {name: decode_cell((FOLDER / name).read_bytes()) for name in CELLS}
    commit, _ = open_commit((FOLDER / "v1.commit").read_bytes())
    frames = frames_of((FOLDER / "v1.reply").read_bytes())
    payloads = [frame for frame in frames if isinstance(frame, CellFrame) and frame.payload]
    meta = json.loads(
        commit.meta.model_dump_json(exclude={"layers", "epoch", "marks", "layer"})
    )  # fields of later versions
    return {
        "geometry": GEOMETRY.digest().hex(),
        "digests": {name: cell.digest.hex() for name, cell in cells.items()},
        "fingerprints": {name: fingerprint(cell.evidence, cell.key).hex() for name, cell in cells.items()},
        "commit": {"sha": commit.sha.hex(), "meta": meta},
        "reply": [type(frame).__name__ + getattr(getattr(frame, "kind", None), "name", "") for frame in frames],
        "payloads": [decode_cell(frame.payload).digest.hex() for frame in payloads],
    }


def found_with_epochs() -> dict[str, object]:
    """What the stored bytes of version 2 say today."""
    cells = {name: decode_history((FOLDER / name).read_bytes()) for name in EPOCH_CELLS}
    commit, _ = open_commit((FOLDER / "v2.commit").read_bytes())
    return {
        "layer": LAYER.digest().hex(),
        "digests": {name: cell.digest.hex() for name, cell in cells.items()},
        "epochs": {name: [*cell.history] for name, cell in cells.items()},
        "fingerprints": {
            name: history_fingerprint(cell.history, cell.key, layer_word=LAYER.word).hex()
            for name, cell in cells.items()
        },
        "commit": {
            "sha": commit.sha.hex(),
            "meta": json.loads(commit.meta.model_dump_json(exclude={"marks", "layer"})),
        },
    }


def found_with_marks() -> dict[str, object]:
    """Content of the stored bytes of version 3, as it is read today."""
    commit, _ = open_commit((FOLDER / "v3.commit").read_bytes())
    meta = commit.meta.model_dump_json(exclude={"layer": True, "marks": {"__all__": {"attachment"}}})  # later fields
    return {"commit": {"sha": commit.sha.hex(), "meta": json.loads(meta)}}


def found_with_attachments() -> dict[str, object]:
    """Content of the stored bytes of version 3 with an attachment, as it is read today."""
    commit, _ = open_commit((FOLDER / "v3-attachment.commit").read_bytes())
    return {"commit": {"sha": commit.sha.hex(), "meta": json.loads(commit.meta.model_dump_json(exclude={"layer"}))}}


def found_with_layer() -> dict[str, object]:
    """Content of the stored bytes of version 4, as it is read today."""
    commit, _ = open_commit((FOLDER / "v4.commit").read_bytes())
    return {"commit": {"sha": commit.sha.hex(), "meta": json.loads(commit.meta.model_dump_json())}}


def found_with_classes() -> dict[str, object]:
    """Content of the stored bytes of a cell of classes, as it is read today."""
    cell = decode_cell((FOLDER / CLASS_CELL).read_bytes())
    return {
        "geometry": cell.geometry.digest().hex(),
        "digest": cell.digest.hex(),
        "fingerprint": fingerprint(cell.evidence, cell.key).hex(),
    }


def found_of_layers() -> dict[str, object]:
    """Content of the stored bytes of cells of flat voxels and of classes, as it is read today."""
    cells = {name: decode_cell((FOLDER / name).read_bytes()) for name in LAYER_CELLS}
    dated = {name: decode_history((FOLDER / name).read_bytes()) for name in LAYER_EPOCH_CELLS}
    return {
        "geometries": {name: cell.geometry.digest().hex() for name, cell in cells.items()},
        "layers": {name: cell.layer.digest().hex() for name, cell in dated.items()},
        "digests": {name: cell.digest.hex() for name, cell in (cells | dated).items()},
        "fingerprints": {name: fingerprint(cell.evidence, cell.key).hex() for name, cell in cells.items()}
        | {
            name: history_fingerprint(cell.history, cell.key, layer_word=cell.layer.word).hex()
            for name, cell in dated.items()
        },
    }


def main() -> None:
    """Write what is missing."""
    for name, data in made().items():
        if not (FOLDER / name).exists():
            (FOLDER / name).write_bytes(data)
    if not (FOLDER / "v1.json").exists():
        (FOLDER / "v1.json").write_text(json.dumps(found(), indent=1, sort_keys=True) + "\n")
    if not (FOLDER / "v2.json").exists():
        (FOLDER / "v2.json").write_text(json.dumps(found_with_epochs(), indent=1, sort_keys=True) + "\n")
    if not (FOLDER / "v3.json").exists():
        (FOLDER / "v3.json").write_text(json.dumps(found_with_marks(), indent=1, sort_keys=True) + "\n")
    if not (FOLDER / "v4.json").exists():
        (FOLDER / "v4.json").write_text(json.dumps(found_with_layer(), indent=1, sort_keys=True) + "\n")
    if not (FOLDER / "v3-attachment.json").exists():
        (FOLDER / "v3-attachment.json").write_text(
            json.dumps(found_with_attachments(), indent=1, sort_keys=True) + "\n"
        )
    if not (FOLDER / "v1-classes.json").exists():
        (FOLDER / "v1-classes.json").write_text(json.dumps(found_with_classes(), indent=1, sort_keys=True) + "\n")
    if not (FOLDER / "layer-cells.json").exists():
        (FOLDER / "layer-cells.json").write_text(json.dumps(found_of_layers(), indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
