"""Commits to bytes and back."""

import json
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.costly import air, dust
from tests.fixtures.map.made import (
    DOSE,
    GEOMETRIES,
    KEY,
    MIDDLE,
    PLAIN,
    ROBOT,
    SMALL,
    commit_bytes,
    made_commit,
    made_meta,
    random_evidence,
)
from tests.fixtures.map.stored import recoded
from tests.naive import wire as naive_wire

from cairn_map.codec.cell_code import encode_cell
from cairn_map.commits import commit
from cairn_map.commits.commit import (
    BRICKS_ALLOWANCE,
    BRICKS_MAX,
    BRICKS_PER_BYTE,
    CELLS_MAX,
    COMMIT_BYTES_MAX,
    EVIDENCE_BYTES_MAX,
    HEAD,
    META_BYTES_MAX,
    Commit,
    CommitMeta,
    check_bricks,
    check_evidence_size,
    evidence_limit_bytes,
    make_commit,
)
from cairn_map.commits.commit_reading import open_commit
from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.evidence.brick_cell import difference
from cairn_map.evidence.evidence import Evidence, empty_evidence
from cairn_map.evidence.grid import Geometry, cell_key


def refusal(data: bytes) -> str:
    with pytest.raises(CairnError) as refused:
        open_commit(data)
    return refused.value.kind


@given(st.integers(0, 10**6), st.sampled_from(GEOMETRIES))
def test_opening_undoes_making(seed: int, geometry: object) -> None:
    made = made_commit(seed, geometry)  # type: ignore[arg-type]
    opened, cells = open_commit(made.data)
    assert opened == made
    assert {key: cell.evidence for key, cell in cells.items()} == {
        cell_key((0, 0, 0)): random_evidence(seed, geometry, voxels=20, air=1),  # type: ignore[arg-type]
        KEY: random_evidence(seed + 1, geometry, voxels=20, air=1),  # type: ignore[arg-type]
    }


def test_the_sha_is_what_its_twin_says() -> None:
    made = made_commit()
    text = made.meta.model_dump_json(exclude_defaults=True).encode()
    assert naive_wire.commit_parts(made.data) == (text, [*made.cells.values()], made.sha)


@pytest.mark.parametrize("level", [None, 1, 19])
def test_the_sha_does_not_depend_on_compression(level: int | None) -> None:
    made = made_commit(geometry=MIDDLE)
    meta, cells, _ = naive_wire.commit_parts(made.data)
    other = commit_bytes(meta, [recoded(cell, level=level) for cell in cells])
    assert other != made.data
    assert open_commit(other)[0].sha == made.sha


def test_the_sha_depends_on_meta_and_evidence() -> None:
    shas = {made_commit(0).sha, made_commit(5).sha, made_commit(0, note="x").sha, made_commit(0, n=1).sha}
    assert len(shas) == 4


def test_cells_without_evidence_are_left_out() -> None:
    made = make_commit(made_meta(PLAIN), {KEY: empty_evidence(PLAIN)}, PLAIN)
    assert made.cells == {}
    assert open_commit(made.data) == (made, {})


def test_a_retract_names_others_and_has_no_cells() -> None:
    made = make_commit(made_meta(PLAIN, n=9, retracts=(f"{ROBOT}.3", f"{ROBOT}.4")), {}, PLAIN)
    opened, cells = open_commit(made.data)
    assert [str(commit) for commit in opened.meta.retracted_ids] == [f"{ROBOT}.3", f"{ROBOT}.4"]
    assert str(opened.id) == f"{ROBOT}.9"
    assert cells == {}


@pytest.mark.parametrize("retracts", [[f"{ROBOT}.0"], [f"{ROBOT}.1", f"{ROBOT}.1"], ["mole"], [f"{ROBOT}.01"]])
def test_a_retract_names_each_other_commit_once(retracts: list[str]) -> None:
    meta = json.loads(made_meta(PLAIN).model_dump_json()) | {"retracts": retracts}
    assert refusal(commit_bytes(json.dumps(meta).encode(), [])) == "bad_commit"


def test_negative_evidence_is_refused_by_maker_and_reader() -> None:
    negative = difference(empty_evidence(SMALL), random_evidence(1, SMALL), SMALL)
    with pytest.raises(BadInputError) as refused:
        make_commit(made_meta(SMALL), {KEY: negative}, SMALL)
    assert refused.value.kind == "negative_evidence"
    meta = made_meta(SMALL).model_dump_json().encode()
    assert refusal(commit_bytes(meta, [encode_cell(KEY, negative, SMALL).data])) == "negative_evidence"


def test_sums_without_weight_are_refused_by_maker_and_reader() -> None:
    sound = random_evidence(1, SMALL)
    samples = sound.samples.copy()
    samples[:, SMALL.planes_of(DOSE.name)] = [5, 0]
    weightless = Evidence(sound.voxels, sound.counts, sound.sampled, samples)
    with pytest.raises(BadInputError) as refused:
        make_commit(made_meta(SMALL), {KEY: weightless}, SMALL)
    assert refused.value.kind == "bad_evidence"
    meta = made_meta(SMALL).model_dump_json().encode()
    assert refusal(commit_bytes(meta, [encode_cell(KEY, weightless, SMALL).data])) == "bad_evidence"


def test_evidence_of_another_geometry_is_refused_by_maker_and_reader() -> None:
    with pytest.raises(BadInputError) as refused:
        make_commit(made_meta(PLAIN), {KEY: random_evidence(1, SMALL)}, SMALL)
    assert refused.value.kind == "other_geometry"
    meta, _, _ = naive_wire.commit_parts(made_commit(geometry=PLAIN).data)
    _, cells, _ = naive_wire.commit_parts(made_commit(geometry=SMALL).data)
    assert refusal(commit_bytes(meta, cells)) == "other_geometry"


def test_cells_must_rise_be_canonical_and_hold_evidence() -> None:
    meta, cells, _ = naive_wire.commit_parts(made_commit(geometry=PLAIN).data)
    assert refusal(commit_bytes(meta, cells[::-1])) == "bad_commit"
    assert refusal(commit_bytes(meta, [cells[0], cells[0]])) == "bad_commit"
    assert refusal(commit_bytes(meta, [encode_cell(KEY, empty_evidence(PLAIN), PLAIN).data])) == "bad_commit"
    assert refusal(commit_bytes(meta, cells, count=3)) == "bad_commit"
    assert refusal(commit_bytes(meta, cells, count=1)) == "bad_commit"
    assert refusal(commit_bytes(meta, cells) + b"\0") == "bad_commit"


def test_too_many_cells_and_too_long_a_meta_are_refused_before_they_are_read() -> None:
    meta = made_meta(PLAIN).model_dump_json().encode()
    assert refusal(commit_bytes(meta, [], count=CELLS_MAX + 1)) == "too_large"
    assert refusal(commit_bytes(b" " * (META_BYTES_MAX + 1), [])) == "too_large"
    assert refusal(HEAD.pack(b"CRCM", 1, (1 << 32) - 1)) == "too_large"


def test_a_maker_is_told_when_no_reader_would_take_the_commit() -> None:
    one = random_evidence(1, PLAIN, voxels=1, air=0)
    with pytest.raises(BadInputError) as refused:
        make_commit(made_meta(PLAIN), {cell_key((n, 0, 0)): one for n in range(CELLS_MAX + 1)}, PLAIN)
    assert refused.value.kind == "too_large"


@given(st.integers(0, COMMIT_BYTES_MAX))
def test_a_commit_stands_for_more_the_more_bytes_it_has_up_to_a_bound(size_bytes: int) -> None:
    bricks = min(BRICKS_MAX, BRICKS_ALLOWANCE + BRICKS_PER_BYTE * size_bytes)
    check_bricks(bricks, size_bytes=size_bytes)
    check_evidence_size(evidence_limit_bytes(size_bytes), evidence_limit_bytes(size_bytes))
    assert evidence_limit_bytes(0) <= evidence_limit_bytes(size_bytes) <= EVIDENCE_BYTES_MAX
    with pytest.raises(BadInputError, match="fewer scans") as refused:
        check_bricks(bricks + 1, size_bytes=size_bytes)
    assert refused.value.kind == "too_large"


@pytest.mark.parametrize("costly", [dust, air])
def test_dust_and_air_are_refused_where_few_bytes_stand_for_much(
    costly: Callable[[Geometry], Evidence], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_commit(made_meta(MIDDLE), {KEY: costly(MIDDLE)}, MIDDLE)
    monkeypatch.setattr(commit, "BRICKS_ALLOWANCE", 0)
    monkeypatch.setattr(commit, "BRICKS_PER_BYTE", 0)
    with pytest.raises(BadInputError, match="fewer scans"):
        make_commit(made_meta(MIDDLE), {KEY: costly(MIDDLE)}, MIDDLE)
    assert refusal(made.data) == "too_large"
    monkeypatch.undo()
    monkeypatch.setattr(commit, "EVIDENCE_ALLOWANCE_BYTES", 0)
    monkeypatch.setattr(commit, "EVIDENCE_PER_BYTE", 0)
    assert refusal(made.data) == "too_large"


def test_a_reader_may_set_how_much_evidence_it_takes() -> None:
    made: Commit = made_commit()
    size_bytes = sum(cell.evidence.size_bytes for cell in open_commit(made.data)[1].values())
    assert open_commit(made.data, evidence_bytes_max=size_bytes)[0] == made
    with pytest.raises(BadInputError) as refused:
        open_commit(made.data, evidence_bytes_max=size_bytes - 1)
    assert refused.value.kind == "too_large"


@pytest.mark.parametrize("version", [0, 5, 255])
def test_other_versions_are_refused_as_unknown(version: int) -> None:
    data = bytearray(made_commit().data)
    data[4] = version
    assert refusal(bytes(data)) == "unknown_version"


GEOMETRY = PLAIN.digest().hex()
SOUND = f'"id":"{ROBOT}.0","geometry":"{GEOMETRY}"'


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "null",
        "{" + SOUND,
        "{" + SOUND + ',"more":1}',
        "{" + SOUND + ',"captured_s":[NaN,1]}',
        "{" + SOUND + ',"captured_s":[Infinity,1]}',
        "{" + SOUND + ',"captured_s":[1e999,1]}',
        "{" + SOUND + ',"captured_s":["1",2]}',
        "{" + SOUND + ',"captured_s":[true,2]}',
        "{" + SOUND + ',"captured_s":[1' + "0" * 5000 + ",2]}",
        "{" + SOUND + ',"note":"\\ud800"}',
        "{" + SOUND + ',"note":"' + "x" * 1025 + '"}',
        "{" + SOUND + ',"note":"a","note":"b"}',
        "{" + SOUND + ',"scans":' + "[" * 100_000,
        "{" + SOUND + ',"scans":[' + ",".join(["0"] * 5000) + "]}",
        "{" + ",".join(f'"{n}":0' for n in range(20_000)) + "}",
        "{" + SOUND.replace("mole", "Mole") + "}",
        "{" + SOUND.replace(GEOMETRY, GEOMETRY.upper()) + "}",
        "{" + SOUND.replace(GEOMETRY, GEOMETRY + "\\n") + "}",
        "\ufeff{" + SOUND + "}",
    ],
    ids=lambda text: text[-30:][:30],
)
def test_a_meta_that_is_not_what_the_format_says_is_refused(text: str) -> None:
    assert refusal(commit_bytes(text.encode(), [])) == "bad_commit"


def test_meta_that_is_not_utf_8_is_refused() -> None:
    assert refusal(commit_bytes(("{" + SOUND + ',"note":"é"}').encode("latin-1"), [])) == "bad_commit"


def test_one_key_twice_in_an_inner_object_is_refused() -> None:
    pose = '{"time_s":1,"time_s":2,"t_map_rig":[0,0,0],"q_map_rig":[0,0,0,1]}'
    assert refusal(commit_bytes(("{" + SOUND + ',"scans":[' + pose + "]}").encode(), [])) == "bad_commit"


def test_the_largest_finite_numbers_are_read() -> None:
    text = "{" + SOUND + ',"captured_s":[-1.7e308,1' + "0" * 300 + "]}"
    assert open_commit(commit_bytes(text.encode(), []))[0].meta.captured_s == (-1.7e308, 1e300)


def test_meta_of_the_wrong_kind_of_object_is_an_error_and_no_crash() -> None:
    with pytest.raises(DamagedDataError, match="commit meta: id"):
        open_commit(commit_bytes(b"{}", []))
    assert CommitMeta.model_validate_json("{" + SOUND + "}") == CommitMeta(id=f"{ROBOT}.0", geometry=GEOMETRY)
