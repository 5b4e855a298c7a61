"""`cairn map create --epoch`, and what `cairn map info` says of maps with epochs."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY
from tests.fixtures.server.epoch_contract import cell_of, fold_by_hand
from tests.fixtures.server.pushes import KEYS

from cairn_client.http.api import MapApi
from cairn_client.main import main
from cairn_map.epochs.epoch import EPOCH_S_MAX, STANDARD_EPOCH_S
from cairn_map.wire.messages import CreateMap


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    server = LiveServer(tmp_path_factory.mktemp("server"))
    yield server
    server.stop()


def test_a_map_is_made_with_the_epochs_that_are_asked_for(live: LiveServer, capsys: pytest.CaptureFixture[str]) -> None:
    for name, words, epoch_s in (
        ("lab", ["--epoch", "600"], 600),
        ("still", ["--epoch", "none"], None),
        ("plain", [], STANDARD_EPOCH_S),
    ):
        assert main(["map", "create", f"{live.url}/maps/{name}", "--voxel", "0.08", *words]) == 0
        assert ("epochs of 600 s" in capsys.readouterr().out) == (epoch_s == 600)
        with MapApi(live.url) as api:
            assert api.map_info(name).epoch_s == epoch_s
    assert main(["map", "create", f"{live.url}/maps/lab", "--voxel", "0.08", "--epoch", "120"]) == 4
    refused = capsys.readouterr().err
    assert "epochs of 600 s" in refused and "epochs of 120 s" in refused and "map_exists" in refused


@pytest.mark.parametrize("text", ["0", "-5", "1.5", "", "ten", "None", "²", str(EPOCH_S_MAX + 1)])
def test_a_length_that_cannot_be_is_refused_before_a_map_is_made(
    live: LiveServer, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    assert main(["map", "create", f"{live.url}/maps/bad", f"--epoch={text}"]) == 1
    assert "bad_epoch" in capsys.readouterr().err
    with MapApi(live.url) as api:
        assert "bad" not in {info.name for info in api.maps()}


def test_a_map_from_another_has_its_epochs_unless_others_are_asked_for(live: LiveServer) -> None:
    with MapApi(live.url) as api:
        api.create_map("source", CreateMap(geometry=GEOMETRY, epoch_s=300))
        source = f"{live.url}/maps/source"
        for name, words, epoch_s in (
            ("same", [], 300),
            ("other", ["--epoch", "60"], 60),
            ("sum", ["--epoch", "none"], None),
        ):
            assert main(["map", "create", f"{live.url}/maps/{name}", "--from", source, *words]) == 0
            assert api.map_info(name).epoch_s == epoch_s


def test_the_info_tells_the_bytes_of_history_beside_those_of_the_present(
    live: LiveServer, capsys: pytest.CaptureFixture[str]
) -> None:
    store = live.service.store
    with MapApi(live.url) as api:
        api.create_map("told", CreateMap(geometry=GEOMETRY, epoch_s=120))
        api.create_map("untold", CreateMap(geometry=GEOMETRY))
    row = store.map("told")
    fold_by_hand(store, row, [cell_of(KEYS[0], lm=0, history_bytes=2000, present_bytes=500)])
    assert main(["map", "info", f"{live.url}/maps/told"]) == 0
    said = capsys.readouterr().out
    assert "epochs of 120 s" in said and "2.5 kB (500 B of the present, 2.0 kB of history)" in said
    assert main(["map", "info", f"{live.url}/maps/untold"]) == 0
    said = capsys.readouterr().out
    assert "epochs" not in said and "history" not in said
    for name, told in (("told", (120, 2000)), ("untold", (None, None))):
        assert main(["map", "info", f"{live.url}/maps/{name}", "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert (facts.get("epoch_s"), facts.get("history_bytes")) == told


def test_a_copy_has_the_epochs_of_its_source_and_is_not_made_onto_others(
    live: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = LiveServer(tmp_path / "other")
    try:
        with MapApi(live.url) as here, MapApi(other.url) as there:
            for name in ("moved", "differs"):
                here.create_map(name, CreateMap(geometry=GEOMETRY, epoch_s=120))
            there.create_map("differs", CreateMap(geometry=GEOMETRY))
            assert main(["map", "copy", f"{live.url}/maps/moved", f"{other.url}/maps/moved"]) == 0
            assert there.map_info("moved").epoch_s == 120
        assert main(["map", "copy", f"{live.url}/maps/differs", f"{other.url}/maps/differs"]) == 1
        refused = capsys.readouterr().err
        assert "epochs of 120 s here" in refused and "no epochs there" in refused
    finally:
        other.stop()
