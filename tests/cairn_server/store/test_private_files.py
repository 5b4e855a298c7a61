"""Store and files next to it are their user's alone, in any folder, with any umask; wide secrets are warned of."""

import os
import stat
from pathlib import Path

import pytest
from tests.fixtures.server.live import Live
from tests.fixtures.server.pushes import pushed

from cairn_server.operations.serve import main
from cairn_server.operations.serve_options import serve_parser, settings_of
from cairn_server.store.sqlite.ended_tokens import LIST_NAME
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore

SECRETS = (FILE_NAME, f"{FILE_NAME}-wal", f"{FILE_NAME}-shm", LIST_NAME, "last-backup")


@pytest.fixture
def wide(tmp_path: Path) -> Path:
    """A folder that the administrator made, open to all."""
    (folder := tmp_path / "data").mkdir()
    folder.chmod(0o777)
    return folder


def modes(folder: Path) -> dict[str, int]:
    return {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir() if path.name in SECRETS}


def test_in_any_folder_and_with_any_umask_others_read_nothing(wide: Path, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        store = SqliteStore(wide)
        main(["backup", "--data", str(wide), str(tmp_path / "nightly.cairn")])
        assert modes(wide) == dict.fromkeys(SECRETS, 0o600)
        assert stat.S_IMODE((tmp_path / "nightly.cairn").stat().st_mode) == 0o600
        store.close()
        main(["restore", str(tmp_path / "nightly.cairn"), "--data", str(tmp_path / "new"), "--old", str(wide)])
        assert set(modes(tmp_path / "new").values()) == {0o600}
    finally:
        os.umask(before)


def test_a_store_that_an_earlier_version_left_open_is_closed_at_the_next_start(wide: Path) -> None:
    with Live(wide, store=SqliteStore(wide)) as live:
        live.push(live.new_map(), pushed(0, 0))
        for name in modes(wide):
            (wide / name).chmod(0o644)
        # Killed here, the log and its index would stay: a second opening finds them as they lie.
        (copy := wide.parent / "copy").mkdir()
        for name in modes(wide):
            (copy / name).write_bytes((wide / name).read_bytes())
            (copy / name).chmod(0o666)
    store = SqliteStore(copy)
    assert set(modes(copy).values()) == {0o600}
    store.close()


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o644, 0o602])
def test_a_secret_that_others_may_get_at_is_warned_of_with_the_command(
    mode: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (path := tmp_path / "secret").write_text("s" * 20)
    path.chmod(mode)
    settings_of(serve_parser("").parse_args(["--admin-token-file", str(path)]))
    assert (f"chmod 600 {path}" in caplog.text) == bool(mode & 0o007)
