"""`cairn serve --store` and `serve check --store` over a real database: roles, refusals, and findings."""

from pathlib import Path

import httpx
import pytest
from tests.fixtures.server.database_servers import ended, folded, push, served
from tests.fixtures.server.live import Process, until
from tests.fixtures.server.postgres import Database
from tests.fixtures.server.pushes import pushed

from cairn_map.errors import BadInputError, DamagedDataError
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
