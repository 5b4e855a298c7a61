"""Synchronisation of maps with epochs: SYNC.md's rules for all rows, and clients that know one sum for all times."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fixtures.map.histories import LAYER
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.epoch_pushes import KNOWS_EPOCHS, pushed_in, read_rows, rows_of
from tests.fixtures.server.fetching import ask_missing, fetch
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import KEYS, MOLE, WREN, pushed, read, sum_of
from tests.naive.asker import cell_frames
from tests.naive.epoch_asker import NaiveEpochAsker

from cairn_map.codec.cell_code import decode_cell
from cairn_map.codec.layer_code import decode_layer_cell
from cairn_map.commits.commit import split_commit
from cairn_map.commits.commit_reading import validated_commit
from cairn_map.epochs.cell_history import NOTHING
from cairn_map.epochs.epoch import Epoch
from cairn_map.epochs.layer import MapLayer
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import cell_key, cell_of_key
from cairn_map.wire.frames import FrameKind, frames_of
from cairn_map.wire.messages import CellCursor, CreateMap, MapInfo, Register

EPOCHS = st.sampled_from([None, Epoch(0), Epoch(3), Epoch(4)])
FAR = cell_key((500, -500, 3))


@settings(max_examples=12)
@given(st.data())
def test_an_asker_that_comes_now_and_then_always_ends_with_the_server_s_rows(live: Live, data: st.DataObject) -> None:
    row = live.new_map(epoch_s=LAYER.epoch_s)
    kinds = data.draw(st.sampled_from([("delta", "full"), ("state", "full"), ("delta", "state", "full"), ()]))
    asker = NaiveEpochAsker(data.draw(st.sampled_from([MOLE, WREN, None])), asks_for=kinds)
    drawn = st.integers(0, 5)
    commits = [pushed_in(data.draw(EPOCHS), n, data.draw(drawn), author) for author in (MOLE, WREN) for n in range(4)]
    steps = data.draw(st.lists(st.sampled_from(["push", "push", "retract", "fetch"]), max_size=12))
    waiting, there, gone = list(data.draw(st.permutations(commits))), [], []
    for step in [*steps, "fetch"]:
        if step == "push" and waiting:
            there.append(commit := waiting.pop())
            assert live.push(row, commit).status_code == 201
            if commit.id.author == asker.author:
                asker.own[commit.id.n] = commit
        elif step == "retract":
            gone.append(data.draw(st.sampled_from(commits)))
            assert live.retract(row, gone[-1]).status_code == 201
        elif step == "fetch":
            fetch(live, row, asker)
            assert asker.rows() == read_rows(live.cells(row)) == rows_of(c for c in there if c not in gone)


def test_one_foreign_commit_comes_as_its_own_bytes_in_a_row_of_its_epoch(live: Live) -> None:
    row, asker = live.new_map(epoch_s=LAYER.epoch_s), NaiveEpochAsker(MOLE)
    for n in range(12):
        live.push(row, pushed_in(Epoch(3), n, n, WREN))
    fetch(live, row, asker)
    asker.kinds.clear()
    live.push(row, pushed_in(Epoch(5), 12, 1, WREN))
    frames = cell_frames(fetch(live, row, asker))
    assert set(asker.kinds) == {FrameKind.DELTA}
    for key, body in pushed_in(Epoch(5), 12, 1, WREN).cells.items():
        history = decode_layer_cell(frames[key].payload, key, LAYER).history
        assert history.rows[Epoch(5)] == decode_cell(body).evidence


def test_state_frames_hold_all_rows_of_the_changed_blocks(live: Live) -> None:
    row, asker = live.new_map(epoch_s=LAYER.epoch_s), NaiveEpochAsker(MOLE, asks_for=("state", "full"))
    commits = [pushed_in(Epoch(n % 3), n, n, WREN) for n in range(12)]
    for commit in commits:
        live.push(row, commit)
    fetch(live, row, asker)
    asker.kinds.clear()
    live.retract(row, commits[4])
    frames = cell_frames(fetch(live, row, asker))
    assert FrameKind.STATE in asker.kinds
    assert asker.rows() == rows_of([*commits[:4], *commits[5:]])
    assert any(
        len(decode_layer_cell(frame.payload, key, LAYER).history) > 1
        for key, frame in frames.items()
        if frame.kind is FrameKind.STATE
    )


def test_a_cell_that_the_server_never_had_comes_empty_with_the_map_s_layer(live: Live) -> None:
    row = live.new_map(epoch_s=LAYER.epoch_s)
    for cells in ([FAR], [cell_key((n, 7, 7)) for n in range(300)]):
        asked = NaiveEpochAsker(None).request(cells=[CellCursor(cell=cell_of_key(key), cursor=None) for key in cells])
        frames = cell_frames(frames_of(ask_missing(live, row, asked).content))
        assert frames.keys() == set(cells)
        for key, frame in frames.items():
            assert decode_layer_cell(frame.payload, key, LAYER).history == NOTHING


def test_two_servers_that_got_the_same_commits_in_other_orders_have_the_same_bytes(live: Live) -> None:
    commits = [pushed_in(Epoch(n % 3), n, n, (MOLE, WREN)[n % 2]) for n in range(8)]
    rows = [live.new_map(epoch_s=LAYER.epoch_s) for _ in range(2)]
    for row, order in zip(rows, (commits, commits[::-1]), strict=True):
        for commit in order:
            live.push(row, commit)
        live.retract(row, commits[3])
    assert live.cells(rows[0]) == live.cells(rows[1])
    heads = [live.service.maps.info(row) for row in rows]
    assert heads[0].history_bytes == heads[1].history_bytes > 0


@pytest.mark.parametrize("epoch_s", [120, None])
def test_commits_of_version_1_go_into_the_base_of_any_map_of_the_grid(live: Live, epoch_s: int | None) -> None:
    row, commits = live.new_map(epoch_s=epoch_s), [pushed(n, n) for n in range(3)]
    for commit in commits:
        assert live.push(row, commit).status_code == 201
    if epoch_s is None:
        assert read(live.cells(row)) == sum_of(commits)
    else:
        assert read_rows(live.cells(row)) == {key: {None: cell} for key, cell in sum_of(commits).items()}


def test_commits_of_other_layers_are_refused_and_both_lengths_are_named(live: Live) -> None:
    plain, other = live.new_map(), live.new_map(epoch_s=600)
    for row, said in ((plain, "no epochs"), (other, "epochs of 600 s")):
        refused = live.push(row, pushed_in(Epoch(3), 0, 1))
        assert (refused.status_code, kind_of(refused)) == (400, "other_layer")
        assert "epochs of 120 s" in refused.text and said in refused.text
    finer = MapLayer(geometry=SMALL.model_copy(update={"voxel_edge_um": 20_000}), epoch_s=120)
    assert kind_of(live.push(live.new_map(epoch_s=120), pushed_in(Epoch(3), 0, 1, layer=finer))) == "other_geometry"


def test_commits_and_operators_retracts_leave_a_map_with_epochs_as_they_can_be_pushed_elsewhere(live: Live) -> None:
    row, commit = live.new_map(epoch_s=LAYER.epoch_s), pushed_in(Epoch(3), 0, 1)
    live.push(row, commit)
    retract_id = live.retract(row, commit).json()["id"]
    live.folded(row)
    found = live.http.get(f"/maps/{row.name}/commits/{commit.id}")
    assert found.content == commit.data
    retract = live.http.get(f"/maps/{row.name}/commits/{retract_id}")
    meta, cells = split_commit(retract.content)
    assert (meta.layers, meta.retracts, cells) == (LAYER.identities, (str(commit.id),), {})
    assert f'"{validated_commit(retract.content).sha.hex()}"' == retract.headers["ETag"]
    seal = {"Cairn-Seal": retract.headers["Cairn-Seal"]}
    again = live.http.put(f"/maps/{row.name}/commits/{retract_id}", content=retract.content, headers=seal)
    assert again.status_code == 200


def test_a_client_that_reads_version_1_gets_totals_or_is_told_to_update(live: Live) -> None:
    row, commits = live.new_map(epoch_s=LAYER.epoch_s), [pushed_in(Epoch(n), n, 1) for n in range(3)]
    for commit in commits:
        live.push(row, commit)
    live.folded(row)
    # Registration and fetch-missing need rows.
    asked = NaiveEpochAsker(None).request()
    refused = ask_missing(live, row, asked, version=1)
    assert (refused.status_code, kind_of(refused)) == (400, "unknown_version")
    register = Register(robot="mole", mode="high-end", incarnation=MOLE.incarnation, sensors=[]).model_dump()
    refused = live.http.post(f"/maps/{row.name}/branches", json=register)
    assert (refused.status_code, kind_of(refused)) == (400, "unknown_version")
    assert live.http.post(f"/maps/{row.name}/branches", json=register, headers=KNOWS_EPOCHS).status_code == 201
    # Single cells are sums of all rows.
    for key in KEYS[1:]:
        url = f"/maps/{row.name}/main/cells/{','.join(map(str, cell_of_key(key)))}"
        total, rows = live.http.get(url), live.http.get(url, headers=KNOWS_EPOCHS)
        evidence = decode_cell(total.content).evidence
        assert evidence == decode_layer_cell(rows.content, key, LAYER).history.total(SMALL)
        assert total.headers["Cairn-Fingerprint"] == fingerprint(evidence, key).hex()
        assert total.headers["ETag"] != rows.headers["ETag"]
        assert total.headers["Vary"] == rows.headers["Vary"] == "Cairn-Format"
        assert live.http.get(url, headers={"If-None-Match": total.headers["ETag"]}).status_code == 304


def test_a_map_s_facts_are_those_that_the_client_knows(live: Live) -> None:
    row = live.new_map(epoch_s=LAYER.epoch_s)
    for url in (f"/maps/{row.name}", "/maps"):
        old, new = live.http.get(url).json(), live.http.get(url, headers=KNOWS_EPOCHS).json()
        old, new = ([old], [new]) if isinstance(old, dict) else (old, new)
        assert not any({"epoch_s", "history_bytes"} & info.keys() for info in old)
        assert {MapInfo.model_validate(info).epoch_s for info in new if info["name"] == row.name} == {120}
    body = CreateMap(geometry=SMALL, epoch_s=120).model_dump()
    assert "epoch_s" not in live.http.put(f"/maps/{row.name}", json=body).json()
    assert live.http.put(f"/maps/{row.name}", json=body, headers=KNOWS_EPOCHS).json()["epoch_s"] == 120
