"""`cairn map export` of a part: the file that the console offers, by the line that the console shows."""

from pathlib import Path

import laspy
import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import A, B, seen
from tests.fixtures.client.robots import push_diffs

from cairn_client.cli.maps.command import main
from cairn_map.errors import BadInputError, NotFoundError


def test_a_part_comes_as_every_kind_of_file(
    server: LiveServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 300, kelvin_steps=9)}, {B: seen(5, kelvin_steps=9)})
    files = [tmp_path / f"lab.{form}" for form in ("ply", "pcd", "npz", "laz", "ot", "bt")]
    words = [word for path in files for word in (f"--{path.suffix[1:]}", str(path))]
    assert main(["export", server.map_url, *words, "--floor=-100"]) == 0
    assert f"{files[2]}: " in capsys.readouterr().out
    with np.load(files[2]) as arrays:
        points = arrays["points"]
    assert b"element vertex %d\n" % len(points) in files[0].read_bytes()
    assert b"POINTS %d\n" % len(points) in files[1].read_bytes()
    with laspy.open(files[3]) as laz:
        assert laz.header.point_count == len(points)
    assert files[4].read_bytes().startswith(b"# Octomap OcTree file\n")
    assert files[5].read_bytes().startswith(b"# Octomap OcTree binary file\n")
    heights = np.sort(points["z"])
    ceiling_m = float(heights[0]) + 0.001
    assert main(["export", server.map_url, "--npz", str(files[2]), f"--ceiling={ceiling_m}"]) == 0
    with np.load(files[2]) as arrays:
        assert len(arrays["points"]) == (heights <= ceiling_m).sum() < len(points)


def test_a_band_of_temperatures_is_given_in_degrees_celsius(server: LiveServer, tmp_path: Path) -> None:
    push_diffs(server, tmp_path / "mole", {A: seen(1, 2, 300, kelvin_steps=9)}, {B: seen(5, kelvin_steps=5000)})
    path = tmp_path / "lab.npz"
    kelvin = []
    for words in (["--floor=-100"], ["--hotter=-270"], ["--colder=-270"], ["--hotter=-20", "--colder=50"]):
        assert main(["export", server.map_url, "--npz", str(path), *words]) == 0
        with np.load(path) as arrays:
            kelvin.append(np.sort(arrays["points"]["hottest"]))
    whole, hot, cold, none = kelvin
    np.testing.assert_array_equal(hot, whole[whole >= 3.15])
    np.testing.assert_array_equal(cold, whole[whole <= 3.15])
    assert 0 < len(hot) < len(whole) == len(hot) + len(cold)
    assert len(none) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--floor=1"], "--ply FILE"),
        (["--ply=a.ply", "--box=1,2"], "lower corner first"),
        (["--ply=a.ply", "--p=7"], "less than or equal to 1"),
        (["--laz=a.laz", "--hotter=-300"], "greater than or equal to 0"),
        (["--ply=a.ply", "--p=0.8", "--cells=there"], "--cells"),
        (["--bt=a.bt", "--unknown=free"], "give the box"),
        (["--ply=a.ply", "--box=0,0,0,1,1,1", "--unknown=free"], "OctoMap's octrees only"),
    ],
)
def test_what_cannot_be_a_part_is_said(
    server: LiveServer, tmp_path: Path, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match=said):
        main(["export", server.map_url, *words])
    assert not list(tmp_path.glob("a.*"))


def test_what_was_there_stays_when_the_server_refuses(server: LiveServer, tmp_path: Path) -> None:
    path = tmp_path / "lab.ply"
    path.write_text("mine")
    with pytest.raises(NotFoundError):
        main(["export", server.map_url.replace("/maps/", "/maps/no-"), f"--ply={path}", "--p=0.8"])
    assert [found.name for found in tmp_path.glob("lab*")] == ["lab.ply"]
    assert path.read_text() == "mine"
