"""`cairn map export` of a whole map: cell by cell, within the memory; and other people's texts on the terminal."""

from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, MAP, A, B, seen
from tests.fixtures.client.robots import push_diffs

from cairn_client.cli.maps import map_export
from cairn_client.cli.maps.command import main
from cairn_client.http.api import MapApi
from cairn_client.sync.responses import error_of
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import cell_of_key
from cairn_map.files.cell_folder import read_cells
from cairn_map.wire.messages import Register, RobotStatus


def test_more_voxels_than_the_memory_holds_are_refused_before_they_are_made(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 3)}, {B: seen(5)})
    monkeypatch.setattr(map_export, "standard_limit_bytes", lambda: 100)
    for form in ("npz", "ply"):
        path = tmp_path / f"lab.{form}"
        assert main(["export", server.map_url, "--cells", str(tmp_path / "cells")]) == 0
        push_diffs(server, tmp_path / "mole", {A: seen(7, kelvin_steps=3)})  # occupied, for the points
        with pytest.raises(BadInputError, match="a quarter of this machine's"):
            main(["export", server.map_url, f"--{form}", str(path)])
        assert not path.exists()


def test_a_cell_is_written_before_the_next_one_is_asked_for(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 3)}, {B: seen(5)})
    fetch = map_export.download_cell
    folder, written = tmp_path / "cells", []

    def damaged_second(*asked: object) -> object:
        written.append(sorted(path.name for path in folder.glob("*.cell")))
        if len(written) == 2:
            raise DamagedDataError("bad_cell", "damaged")
        return fetch(*asked)  # type: ignore[arg-type]

    monkeypatch.setattr(map_export, "download_cell", damaged_second)
    with pytest.raises(DamagedDataError):
        main(["export", server.map_url, "--cells", str(folder)])
    first = cell_of_key(min(A, B))
    assert written == [[], [f"{first.i}_{first.j}_{first.k}.cell"]]
    assert [cell.key for cell in read_cells(folder, MapLayer(geometry=GEOMETRY))] == [min(A, B)]


def test_a_robots_note_and_a_servers_detail_do_not_steer_the_terminal(
    server: LiveServer, capsys: pytest.CaptureFixture[str]
) -> None:
    hostile = "\x1b]0;owned\x07\x9b2J\r\u202egnp"
    with MapApi(server.url) as api:
        api.register(MAP, Register(robot="mole", incarnation="0" * 16))
        api.put_status(MAP, "mole", RobotStatus(time_s=1, note=hostile))
    assert main(["branches", server.map_url]) == 0
    shown = capsys.readouterr().out
    assert "owned" in shown
    error = error_of(400, "", b'{"kind":"x y\\u001b[2J","detail":"\\u001b[2J"}')
    assert error.kind == "http"
    detail = error_of(400, "", b'{"kind":"bad_box","detail":"a\\u001b[2J' + b"x" * 5000 + b'"}').message
    assert len(detail) == 1000
    for text in (shown, error.message, detail):
        assert not set(text) & set("\x1b\x07\x9b\r\u202e")
