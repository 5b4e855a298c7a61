"""Commits that define a layer: their bytes, what they cannot be, and that other commits are what they were."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.layers import FINE, OPERATORS, layer_commit
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.map.marks import mark

from cairn_map.commits.commit import (
    CELL_PREFIX,
    HEAD,
    LAYER_VERSION,
    MAGIC,
    MARK_VERSION,
    SUM_VERSION,
    CommitMeta,
    commit_bytes,
    commit_sha,
    make_commit,
    sha_without_evidence,
    split_commit,
    version_of_meta,
)
from cairn_map.commits.commit_reading import open_commit
from cairn_map.commits.ids import map_name, map_of_layer
from cairn_map.epochs.layer import LayerDefinition, MapLayer
from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.evidence.channels import STANDARD_CHANNELS
from cairn_map.evidence.grid import DEPTH_MAX, Geometry, cell_key

GEOMETRIES = st.builds(
    Geometry,
    voxel_edge_um=st.sampled_from([1000, 10_000, 40_000, 1_000_000]),
    depth=st.integers(3, DEPTH_MAX),
    channels=st.sampled_from([(), STANDARD_CHANNELS, SMALL.channels]),
)


def with_meta(version: int, **fields: object) -> bytes:
    """A commit of a version whose meta has these fields."""
    meta = {"id": f"{OPERATORS}.0", "geometry": SMALL.digest().hex()} | fields
    return commit_bytes(
        json.dumps({key: value for key, value in meta.items() if value is not None}).encode(), {}, version=version
    )


@given(geometry=GEOMETRIES, epoch_s=st.none() | st.integers(1, 31_622_400))
def test_a_definition_is_read_as_it_was_made_with_every_depth(geometry: Geometry, epoch_s: int | None) -> None:
    commit = layer_commit(0, "fine", geometry, epoch_s)
    assert commit.data[4] == commit.meta.version == version_of_meta(commit.text) == LAYER_VERSION
    found, cells = open_commit(commit.data)
    assert (found.sha, cells) == (commit.sha, {})
    assert found.meta.layer == LayerDefinition(name="fine", geometry=geometry, epoch_s=epoch_s)
    assert (found.meta, split_commit(commit.data)[0]) == (commit.meta, commit.meta)
    assert sha_without_evidence(commit.data) == commit.sha == commit_sha(commit.text, [], version=LAYER_VERSION)


def test_maps_with_epochs_define_layers_by_their_geometry_too() -> None:
    meta = CommitMeta(
        id=f"{OPERATORS}.0", geometry=SMALL.digest().hex(), layer=LayerDefinition(name="a", geometry=FINE)
    )
    assert make_commit(meta, {}, MapLayer(geometry=SMALL, epoch_s=120)).sha == make_commit(meta, {}, SMALL).sha


def test_a_definition_has_neither_cells_nor_anything_else() -> None:
    layer = LayerDefinition(name="fine", geometry=FINE)
    for fields in ({"marks": (mark(),)}, {"retracts": (f"{OPERATORS}.1",)}, {"epoch": 3}):
        with pytest.raises(ValueError, match=r"layer|epoch"):
            CommitMeta(id=f"{OPERATORS}.0", geometry=SMALL.digest().hex(), layer=layer, **fields)
    meta = layer_commit(0).meta
    with pytest.raises(BadInputError, match="either evidence"):
        make_commit(meta, {cell_key((0, 0, 0)): random_evidence(1, SMALL)}, SMALL)
    cells = {cell_key((0, 0, 0)): b"x" * 50}
    with pytest.raises(DamagedDataError, match="has no cells"):
        split_commit(commit_bytes(layer_commit(0).text, cells, version=LAYER_VERSION))


@pytest.mark.parametrize("name", ["evidence", "Fine", "9fine", "", "a" * 33, "a.b", "a-b", "fine\n"])
def test_names_that_no_layer_has_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="name"):
        LayerDefinition(name=name, geometry=FINE)
    layer = json.loads(layer_commit(0).text)["layer"] | {"name": name}
    with pytest.raises(DamagedDataError, match="commit meta"):
        split_commit(with_meta(LAYER_VERSION, layer=layer))


def test_versions_and_metas_that_do_not_fit_are_refused() -> None:
    layer = json.loads(layer_commit(0).text)["layer"]
    for version, fields in ((SUM_VERSION, {"layer": layer}), (MARK_VERSION, {"layer": layer}), (LAYER_VERSION, {})):
        with pytest.raises(DamagedDataError, match="has the meta of version"):
            split_commit(with_meta(version, **fields))
    for fields in ({"geometry": None}, {"layer": None}, {"layer": []}, {"layer": {"name": "a"}}):
        with pytest.raises(DamagedDataError):
            split_commit(with_meta(LAYER_VERSION, **{"layer": layer} | fields))


@pytest.mark.parametrize(
    "change",
    [
        lambda layer: layer | {"kind": "level"},
        lambda layer: layer | {"keep_epochs": 9},
        lambda layer: layer | {"geometry": layer["geometry"] | {"tilt_mrad": 50}},
    ],
)
def test_definitions_of_newer_programs_are_of_an_unknown_version(change: object) -> None:
    layer = change(json.loads(layer_commit(0).text)["layer"])  # type: ignore[operator]
    with pytest.raises(BadInputError) as refused:
        split_commit(with_meta(LAYER_VERSION, layer=layer))
    assert refused.value.kind == "unknown_version"


@given(cut=st.integers(0, len(layer_commit(0).data) - 1), flip=st.integers(0, len(layer_commit(0).data) * 8 - 1))
def test_truncated_and_flipped_bytes_are_refused_or_another_commit(cut: int, flip: int) -> None:
    data = layer_commit(0).data
    with pytest.raises(CairnError):
        open_commit(data[:cut])
    flipped = bytearray(data)
    flipped[flip // 8] ^= 1 << flip % 8
    try:
        found, _ = open_commit(bytes(flipped))
    except CairnError:
        return
    assert found.sha != layer_commit(0).sha


def test_a_later_version_is_named() -> None:
    assert max(CELL_PREFIX) == LAYER_VERSION
    with pytest.raises(BadInputError, match="version 1 to 4, got 5"):
        split_commit(HEAD.pack(MAGIC, 5, 0) + bytes(4))


def test_a_text_about_layers_is_no_definition() -> None:
    meta = CommitMeta(id=f"{OPERATORS}.0", geometry=SMALL.digest().hex(), note='"layer":{"name":"fine"} layer')
    text = make_commit(meta, {cell_key((0, 0, 0)): random_evidence(1, SMALL)}, SMALL).text
    assert version_of_meta(text) == SUM_VERSION


@pytest.mark.parametrize(("name", "whole"), [("lab", None), ("lab.fine", "lab"), ("0_-.a_9", "0_-")])
def test_the_name_of_a_layer_says_its_map(name: str, whole: str | None) -> None:
    assert (map_name(name), map_of_layer(name)) == (name, whole)


@pytest.mark.parametrize(
    "name", ["", ".fine", "lab.", "lab.Fine", "lab.9", "lab.a.b", "lab.a-b", "Lab", "a" * 33, "lab.fine\n"]
)
def test_texts_that_name_neither_map_nor_layer_are_refused(name: str) -> None:
    with pytest.raises(BadInputError, match=r"MAP\.LAYER") as refused:
        map_name(name)
    assert refused.value.kind == "bad_name"
