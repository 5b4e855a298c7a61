"""Durable file: written whole with its folder, or left as it was before."""

import errno
import os
from pathlib import Path

import pytest

from cairn_client.replica.durable_file import write_durable_file
from cairn_map.errors import UnreachableError


def test_a_file_is_replaced_whole_once_it_is_on_the_disk_or_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "new" / "note.json"
    write_durable_file(path, b"first")
    write_durable_file(path, b"second")
    assert [(each, each.read_bytes()) for each in path.parent.iterdir()] == [(path, b"second")]

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UnreachableError, match="No space left") as refused:
        write_durable_file(path, b"third")
    assert (refused.value.kind, path.read_bytes()) == ("store_failed", b"second")
