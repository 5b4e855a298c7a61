"""Commits of maps with epochs, version 2, to bytes and back."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.histories import LAYER, epoch_commit, epoch_meta
from tests.fixtures.map.made import KEY, MIDDLE, SMALL, commit_bytes, made_commit, made_meta, random_evidence
from tests.naive import wire as naive_wire

from cairn_map.commits.commit import (
    EPOCH_VERSION,
    HEAD,
    SUM_VERSION,
    Commit,
    make_commit,
    renamed_commit,
    sha_without_evidence,
    split_commit,
)
from cairn_map.commits.commit import commit_bytes as bytes_of
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.epochs.epoch import BASE, EPOCH_MAX
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, CairnError
from cairn_map.evidence.grid import cell_key

MADE = epoch_commit()


def refusal(data: bytes) -> str:
    with pytest.raises(CairnError) as refused:
        open_commit(data)
    return refused.value.kind


def with_meta(version: int = EPOCH_VERSION, **changes: object) -> bytes:
    """Bytes of a commit whose meta is changed, whatever it then says."""
    fields = json.loads(MADE.text) | changes
    text = json.dumps({name: value for name, value in fields.items() if value is not None}).encode()
    return bytes_of(text, MADE.cells, version=version)


@given(st.integers(0, 10**6), st.one_of(st.none(), st.integers(-EPOCH_MAX, EPOCH_MAX)))
def test_opening_undoes_making(seed: int, epoch: int | None) -> None:
    made = epoch_commit(seed, epoch=epoch)
    opened, cells = open_commit(made.data)
    assert opened == made
    assert (opened.meta.version, opened.meta.row) == (EPOCH_VERSION, BASE if epoch is None else epoch)
    assert [cells[key].evidence for key in (cell_key((0, 0, 0)), KEY)] == [
        random_evidence(seed + n, SMALL, voxels=20, air=1) for n in range(2)
    ]
    assert split_commit(made.data) == (made.meta, made.cells)


def test_the_sha_is_what_its_twin_says() -> None:
    meta, cells, sha = naive_wire.commit_parts(MADE.data)
    assert (meta, cells, sha) == (MADE.text, list(MADE.cells.values()), MADE.sha)


def test_the_epoch_and_the_layer_are_part_of_the_identity() -> None:
    others = [epoch_commit(epoch=8), epoch_commit(epoch=None), made_commit()]
    assert len({MADE.sha, *(other.sha for other in others)}) == 4


def test_a_renamed_commit_keeps_its_epoch_and_version() -> None:
    renamed = renamed_commit(MADE.data, commit=commit_id_from_text("mole.0123456789abcdef.9"), parent=None)
    assert open_commit(renamed.data)[0] == renamed
    assert (renamed.meta.epoch, renamed.meta.layers) == (7, LAYER.identities)


def test_a_retract_has_no_evidence_and_a_sha_of_its_version() -> None:
    retract = make_commit(epoch_meta(retracts=("wren.0123456789abcdef.4",)), {}, LAYER)
    assert sha_without_evidence(retract.data) == retract.sha


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (with_meta(SUM_VERSION), "bad_commit"),
        (bytes_of(made_commit().text, made_commit().cells, version=EPOCH_VERSION), "bad_commit"),
        (with_meta(geometry=SMALL.digest().hex()), "bad_commit"),
        (with_meta(layers=[]), "bad_commit"),
        (with_meta(layers=[json.loads(MADE.text)["layers"][0]] * 2), "bad_commit"),
        (with_meta(layers=[{"geometry": SMALL.digest().hex()}]), "bad_commit"),
        (with_meta(layers=[{"geometry": SMALL.digest().hex(), "epoch_s": 0}]), "bad_commit"),
        (with_meta(layers=[{"geometry": SMALL.digest().hex(), "epoch_s": 120, "kind": "level"}]), "bad_commit"),
        (with_meta(layers=[{"geometry": MIDDLE.digest().hex(), "epoch_s": 120}]), "other_geometry"),
        (with_meta(epoch=EPOCH_MAX + 1), "bad_commit"),
        (with_meta(epoch=-(1 << 62)), "bad_commit"),
        (with_meta(epoch=1.5), "bad_commit"),
        (with_meta(epochs=[1, 2]), "bad_commit"),
        (MADE.data[:4] + b"\xff" + MADE.data[5:], "unknown_version"),
    ],
    ids=[
        *("epochs in version 1", "none in version 2", "both digests", "no layer", "two layers", "no epoch length"),
        *("epochs of 0 s", "another kind", "another geometry", "late", "early", "half an epoch", "many epochs", "255"),
    ],
)
def test_metas_that_contradict_are_refused(data: bytes, kind: str) -> None:
    assert refusal(data) == kind


def test_an_epoch_in_a_version_1_commit_is_refused() -> None:
    text = json.dumps(json.loads(made_commit().text) | {"epoch": 3}).encode()
    assert refusal(commit_bytes(text, list(made_commit().cells.values()))) == "bad_commit"


def test_a_cell_of_a_layer_that_is_not_named_is_refused() -> None:
    at = HEAD.size + len(MADE.text) + 4
    assert refusal(MADE.data[:at] + b"\1" + MADE.data[at + 1 :]) == "bad_commit"


@given(st.integers(0, len(MADE.data) - 1))
def test_cut_bytes_are_refused(size: int) -> None:
    assert refusal(MADE.data[:size]) in ("bad_commit", "bad_cell", "bad_stream", "too_large")


@pytest.mark.parametrize(
    "layer", [MapLayer(geometry=SMALL), MapLayer(geometry=SMALL, epoch_s=60), MapLayer(geometry=MIDDLE)]
)
def test_a_maker_is_told_of_another_layer(layer: MapLayer) -> None:
    with pytest.raises(BadInputError, match="another geometry"):
        make_commit(epoch_meta(), {KEY: random_evidence(0, layer.geometry)}, layer)
    with pytest.raises(BadInputError, match="another geometry"):
        make_commit(made_meta(SMALL), {KEY: random_evidence(0, SMALL)}, LAYER)


def test_commits_are_of_few_bytes_more_than_without_epochs() -> None:
    plain: Commit = make_commit(
        epoch_meta(layers=(), epoch=None, geometry=SMALL.digest().hex()), {KEY: random_evidence(0, SMALL)}, SMALL
    )
    timed = make_commit(epoch_meta(), {KEY: random_evidence(0, SMALL)}, LAYER)
    assert len(timed.data) < len(plain.data) + 64


@pytest.mark.parametrize("field", ["keep_epochs", "weight_max"])
def test_a_layer_that_lets_old_rows_go_is_of_an_unknown_version(field: str) -> None:
    commit = epoch_commit()
    text = commit.text.replace(b'"epoch_s":120', f'"epoch_s":120,"{field}":30'.encode())
    data = bytes_of(text, commit.cells, version=2)
    with pytest.raises(BadInputError) as caught:
        split_commit(data)
    assert caught.value.kind == "unknown_version"
