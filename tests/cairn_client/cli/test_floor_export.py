"""`cairn map export --map-server`: the files that Nav2 loads, by the line that a user types."""

from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.floors import SIDE, push_storey
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.map.nav2_reader import load_map

from cairn_client.cli.maps.command import main
from cairn_map.errors import BadInputError, NotFoundError


def test_a_storey_is_exported_as_nav2_loads_it(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_storey(server, tmp_path / "mole", wall_x=2)
    stem = tmp_path / "floor1"
    assert main(["export", server.map_url, "--map-server", str(stem), "--band", "0.05,0.25"]) == 0
    assert (
        capsys.readouterr().out.strip().endswith("8 x 8 pixels of 5 cm, ground at 0.05 m, 0.1 m2 free, 0.0 m2 occupied")
    )
    loaded = load_map(tmp_path / "floor1.yaml")
    expected = np.zeros((SIDE, SIDE), np.int8)
    expected[:, 2] = 100
    np.testing.assert_array_equal(loaded.data, expected)
    assert loaded.origin == (0.0, 0.0, 0.0)
    assert main(["export", server.map_url, "--map-server", str(stem), "--band=0.05,0.25", "--ground=1"]) == 0
    assert (load_map(tmp_path / "floor1.yaml").data == -1).all()
    assert main(["export", server.map_url, "--map-server", str(stem), "--band=0.05,0.25", "--box=0,0,0,0.1,0.4,1"]) == 0
    np.testing.assert_array_equal(load_map(tmp_path / "floor1.yaml").data, expected[:, :2])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--map-server=a", "--band=0.01,1"], "at least a voxel"),
        (["--map-server=a", "--ply=a.ply"], "run the command once for each"),
        (["--map-server=a", "--ceiling=2"], "--ceiling does not go with --map-server"),
        (["--map-server=a", "--box=1,2"], "lower corner first"),
        (["--map-server=nowhere/a"], "is .*nowhere a folder to write in"),
        (["--ground=1", "--npz=a.npz"], "give --map-server"),
    ],
)
def test_what_cannot_be_a_floor_is_said(
    server: LiveServer, tmp_path: Path, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_storey(server, tmp_path / "mole", wall_x=2)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match=said):
        main(["export", server.map_url, *words])
    assert not list(tmp_path.glob("a*"))


def test_a_map_without_a_floor_is_said(server: LiveServer, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="map the floor, too"):
        main(["export", server.map_url, f"--map-server={tmp_path / 'a'}"])
    assert not list(tmp_path.glob("a*"))


def test_a_band_is_two_heights(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["export", "http://127.0.0.1:9/maps/lab", "--map-server=a", "--band=1"])
    assert ended.value.code == 2
    assert "a band is its lowest and highest height in metres, 0.1,1.5; got '1'" in capsys.readouterr().err
