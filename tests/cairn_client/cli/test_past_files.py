"""`--at` of `cairn map render`, `export` and `get`: what a map showed then is what a map of that evidence shows now."""

from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.client.live_server import LiveServer
from tests.fixtures.client.made import GEOMETRY, A, random_diff, seen

from cairn_client.cli.maps.command import main
from cairn_client.http.api import MapApi
from cairn_client.replica.outbox import CommitFacts
from cairn_client.robot.robot import Robot
from cairn_map.epochs.epoch import Epoch
from cairn_map.errors import BadInputError, ConflictError
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, cell_of_key
from cairn_map.wire.messages import CreateMap

EPOCH_S = 600
THEN = "1970-01-01T01:15"
"""Within epoch 7."""
VIEW = ["--from", "-1,-1,0.3", "--to", "0.2,0.2,0.2", "--size", "64x48"]
CELL = cell_of_key(A)


def pushed(server: LiveServer, folder: Path, name: str, diffs: dict[Epoch, dict[CellKey, Evidence]]) -> str:
    """URL of a map of this evidence by epoch."""
    with MapApi(server.url) as api:
        api.create_map(name, CreateMap(geometry=GEOMETRY, epoch_s=EPOCH_S))
    url = f"{server.url}/maps/{name}"
    with Robot(None, url, directory=folder / name, name="mole") as robot:
        robot.sync()
        for epoch, diff in diffs.items():
            robot.replica.commit(diff, CommitFacts(epoch=epoch))
        assert robot.sync(until_folded=True).is_up_to_date
    return url


def written(url: str, words: list[str], path: Path) -> bytes:
    """Bytes of the file that a command writes."""
    assert main([words[0], url, *words[1:], str(path)]) == 0
    # The head of an octree names its map.
    return path.read_bytes().partition(b"\ndata\n")[2] if path.suffix == ".bt" else path.read_bytes()


def test_files_of_then_are_those_of_a_map_of_what_was_captured_until_then(server: LiveServer, tmp_path: Path) -> None:
    wall, air = seen(*range(30), kelvin_steps=6), seen(*range(30))
    diffs = {Epoch(5): {A: wall}, Epoch(7): random_diff(2)} | {Epoch(n): {A: air} for n in range(8, 14)}
    whole = pushed(server, tmp_path, "whole", diffs)
    until = pushed(server, tmp_path, "until", {epoch: diff for epoch, diff in diffs.items() if epoch <= 7})
    for words in (
        ["export", "--npz"],
        ["export", "--ply"],
        ["export", "--floor=-100", "--npz"],
        ["export", "--bt"],
        ["get", "--output"],
        ["render", *VIEW, "--npz"],
    ):
        place = [f"{CELL.i},{CELL.j},{CELL.k}"] if words[0] == "get" else []
        form = "npz" if words[-1] == "--output" else words[-1][2:]
        asked = [words[0], *place, *words[1:-1]]
        then = written(whole, [*asked, "--at", THEN, words[-1]], tmp_path / f"then.{form}")
        alone = written(until, [*asked, words[-1]], tmp_path / f"alone.{form}")
        now = written(whole, [*asked, words[-1]], tmp_path / f"now.{form}")
        assert then == alone != now, words


def test_a_folder_is_drawn_as_it_was_as_the_server_draws_it(server: LiveServer, tmp_path: Path) -> None:
    wall, air = seen(*range(30), kelvin_steps=6), seen(*range(30))
    url = pushed(server, tmp_path, "hall", {Epoch(5): {A: wall}, Epoch(8): {A: air}, Epoch(9): {A: air}})
    values = []
    cells = tmp_path / "cells"
    assert main(["export", url, "--cells", str(cells)]) == 0
    for place in (url, str(tmp_path / "hall"), str(cells)):
        found = {}
        for layer in ("temperature", "age"):
            words = ["--layer", layer, "--at", THEN, "--npz", str(tmp_path / "then.npz")]
            assert main(["render", place, *VIEW, *words]) == 0
            with np.load(tmp_path / "then.npz") as arrays:
                found |= dict(arrays)
        values.append(found)
    is_seen = np.isfinite(values[0]["range_m"])
    assert is_seen.any()
    # An hour and a quarter less the begin of epoch 5.
    assert set(values[0]["age_s"][is_seen].tolist()) == {4500.0 - 5 * EPOCH_S}
    for name, array in values[0].items():
        for other in values[1:]:
            np.testing.assert_array_equal(array, other[name])


def test_what_has_no_past_is_said(server: LiveServer, tmp_path: Path) -> None:
    url = pushed(server, tmp_path, "hall", {Epoch(5): {A: seen(1, kelvin_steps=6)}})
    with pytest.raises(BadInputError, match="--at goes with files of voxels"):
        main(["export", url, "--at", THEN, "--cells", str(tmp_path / "cells")])
    with pytest.raises(BadInputError, match="--at goes with files of voxels"):
        main(["get", url, "0,0,0", "--at", THEN, "-o", str(tmp_path / "x.cell")])
    with MapApi(server.url) as api:
        api.create_map("plain", CreateMap(geometry=GEOMETRY))
    with Robot(None, f"{server.url}/maps/plain", directory=tmp_path / "plain", name="mole") as robot:
        robot.replica.commit({A: seen(1)})
        robot.sync(until_folded=True)
    with pytest.raises(ConflictError, match="has no epochs"):
        main(["export", f"{server.url}/maps/plain", "--at", THEN, "--npz", str(tmp_path / "x.npz")])
