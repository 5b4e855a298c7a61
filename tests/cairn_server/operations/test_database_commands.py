"""`cairn serve --store` and `serve check --store` over a real database: roles, refusals, and findings."""

from pathlib import Path

import httpx
import pytest
from tests.fixtures.commands import cairn
from tests.fixtures.server.database_servers import ended, folded, push, served
from tests.fixtures.server.live import Process, until
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.pushes import KEYS, pushed

from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.grid import cell_of_key
from cairn_server.operations.serve import main

__all__ = ["ended"]
pytestmark = [pytest.mark.processes, pytest.mark.slow]
COMMITS = [pushed(n, n) for n in range(3)]


def test_one_server_folds_in_a_process_of_its_own_and_the_check_reads_all(
    postgres_database: Database, tmp_path: Path, ended: list[Process], capsys: pytest.CaptureFixture[str]
) -> None:
    url = served(tmp_path / "one", postgres_database, ended)
    push(url, *COMMITS)
    until(lambda: folded(url, len(COMMITS)), "it is folded")
    assert httpx.get(f"{url}/readyz").status_code == 200
    assert main(["check", "--store", postgres_database.url]) == 0
    assert capsys.readouterr().out == "1 maps, 3 commits, 3 cells: all sound\n"
    postgres_database.execute("UPDATE tile SET lm = 0")
    with pytest.raises(DamagedDataError):
        main(["check", "--store", postgres_database.url])
    assert "has not the sums of its cells" in capsys.readouterr().out
    with pytest.raises(BadInputError, match="--repair is for a folder"):
        main(["check", "--store", postgres_database.url, "--repair"])
    with pytest.raises(BadInputError, match="expected a URL like postgresql://"):
        main(["check", "--store", "mysql://x"])


def test_what_a_server_that_does_not_fold_took_is_folded_by_one_that_does_nothing_else(
    postgres_database: Database, tmp_path: Path, ended: list[Process]
) -> None:
    url = served(tmp_path / "answers", postgres_database, ended, "--no-fold")
    push(url, *COMMITS)
    assert folded(url, 0)
    folder = served(tmp_path / "folds", postgres_database, ended, "--fold-only")
    until(lambda: folded(url, len(COMMITS)), "the other one folds it")
    assert httpx.get(f"{folder}/readyz").status_code == 200
    assert "cairn_folded_commits_total" in httpx.get(f"{folder}/metrics").text
    assert httpx.get(f"{folder}/maps/lab").status_code == 404
    assert httpx.get(f"{folder}/maps").status_code == 404


def test_servers_do_not_share_a_folder_and_roles_need_a_database(
    postgres_database: Database, tmp_path: Path, ended: list[Process]
) -> None:
    served(tmp_path / "one", postgres_database, ended)
    second = Process(tmp_path / "one", "--store", postgres_database.url)
    code, said = second.end()
    assert (code, "choose another --data folder" in said) == (4, True), said
    alone = Process(tmp_path / "two", "--no-fold")
    code, said = alone.end()
    assert (code, "SQLite is one process's" in said) == (1, True), said


def test_a_map_becomes_a_file_and_comes_back_while_servers_run(
    newest_postgres: PostgresServer, tmp_path: Path, ended: list[Process]
) -> None:
    database = new_database(newest_postgres)
    site = served(tmp_path / "site", database, ended)
    push(site, *COMMITS)
    until(lambda: folded(site, len(COMMITS)), "it is folded")
    cells = cells_at(site)
    said = cairn("serve", "archive", "lab", "lab.cairn", "--store", database.url, folder=tmp_path)
    assert f"{len(COMMITS)} commits, {len(KEYS)} cells" in said
    cairn("map", "delete", f"{site}/maps/lab", "--yes", folder=tmp_path)
    assert httpx.get(f"{site}/maps/lab").status_code == 410
    said = cairn("serve", "unarchive", "lab.cairn", "--store", database.url, folder=tmp_path)
    assert said.startswith("map lab is in postgresql://127.0.0.1:") and "secret" not in said
    until(lambda: httpx.get(f"{site}/maps/lab").status_code == 200, "the server knows it")
    assert cells_at(site) == cells
    more = pushed(3, 3)
    httpx.put(f"{site}/maps/lab/commits/{more.id}", content=more.data).raise_for_status()
    until(lambda: folded(site, len(COMMITS) + 1), "it is folded, after what came back")


def cells_at(url: str) -> list[bytes]:
    """Bytes of the cells of the map."""
    cells = [cell_of_key(key) for key in KEYS]
    return [httpx.get(f"{url}/maps/lab/main/cells/{cell}").raise_for_status().content for cell in cells]
