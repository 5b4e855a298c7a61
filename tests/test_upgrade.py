"""Stores, backups and robots' folders of the last version without epochs: opened by this one, with all that they hold.

`tests/formats/before-epochs.*.zst` were written by that version: a map `lab` on a server, the server's backup, and the
folder of robot `mole`, whose two commits are on it.
"""

import json
from pathlib import Path

import pytest
import zstandard
from tests.fixtures.commands import cairn, served, wait_for_fold
from tests.formats.make_formats import FOLDER

from cairn_client.cli.arguments import api_of
from cairn_client.folders.map_folder import open_map
from cairn_client.http.api import MapApi
from cairn_client.http.origin_tokens import NO_TOKENS
from cairn_map.errors import BadInputError
from cairn_map.wire.messages import MapInfo

pytestmark = pytest.mark.processes

CELLS, COMMITS = 16, 2
OLD_FIELDS = {
    "name",
    "geometry",
    "sensor_model",
    "cursor",
    "cells",
    "size_bytes",
    "commits",
    "branches",
    "box_m",
    "server_key",
}
"""Fields of a map's facts that the version before epochs knows; it refuses others."""


def unpacked(name: str, path: Path) -> Path:
    """A kept file, in a folder that is made for it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(zstandard.decompress((FOLDER / f"before-epochs.{name}.zst").read_bytes(), max_output_size=1 << 26))
    return path


def info_of(url: str) -> MapInfo:
    """Facts of the map `lab`."""
    with MapApi(url) as api:
        return api.map_info("lab")


def test_a_store_and_a_robot_s_folder_from_before_epochs_go_on_together(tmp_path: Path) -> None:
    unpacked("cairn.sqlite", tmp_path / "server" / "cairn.sqlite")
    unpacked("robot.sqlite", tmp_path / "mole" / "robot.sqlite")
    before = open_map(tmp_path / "mole")
    with served("--data", tmp_path / "server") as url:
        info = info_of(url)
        assert (info.cells, info.commits, info.epoch_s) == (CELLS, COMMITS, None)
        cairn("robot", "sync", "mole", "--map", f"{url}/maps/lab", folder=tmp_path)
        cairn("clone", f"{url}/maps/lab", "copy", folder=tmp_path)
        assert "equal" in cairn("diff", "mole", "copy", folder=tmp_path)
    after = open_map(tmp_path / "copy")
    assert len(after.occupied_in()) == len(before.occupied_in()) > 0
    # Once more: what was upgraded opens as it is.
    with served("--data", tmp_path / "server") as url:
        assert info_of(url).commits == COMMITS


def test_a_backup_from_before_epochs_is_restored(tmp_path: Path) -> None:
    unpacked("nightly.cairn", tmp_path / "nightly.cairn")
    cairn("serve", "restore", "nightly.cairn", "--data", "server", folder=tmp_path)
    with served("--data", tmp_path / "server") as url:
        assert (info_of(url).cells, info_of(url).commits) == (CELLS, COMMITS)


def test_a_client_from_before_epochs_reads_all_maps_and_is_refused_by_name_on_one_with_epochs(tmp_path: Path) -> None:
    with served("--data", tmp_path / "server") as url:
        for name, epoch in (("plain", "none"), ("forgets", "120")):
            cairn("map", "create", f"{url}/maps/{name}", "--voxel", "0.1", "--epoch", epoch, folder=tmp_path)
            wait_for_fold(f"{url}/maps/{name}")
        api, _ = api_of(f"{url}/maps/plain", NO_TOKENS)
        with api:
            # Such a client says nothing of formats.
            old = {"headers": {"Cairn-Format": ""}}
            found = api._send("GET", "/maps", **old).body
            assert all(set(fields) <= OLD_FIELDS for fields in json.loads(found))
            asked = b'{"robot":"mole","mode":"high-end","incarnation":"0123456789abcdef","sensors":[]}'
            assert b'"token"' in api._send("POST", "/maps/plain/branches", content=asked, **old).body
            with pytest.raises(BadInputError, match="update it") as caught:
                api._send("POST", "/maps/forgets/branches", content=asked, **old)
            assert caught.value.kind == "unknown_version"
