"""A server that only folds, as a hardened service: it says that it is ready when it is warm, as all servers do."""

import re
import signal
from pathlib import Path

import pytest
from tests.fixtures.server.database_servers import ended, folded, push, served
from tests.fixtures.server.live import Process, until
from tests.fixtures.server.postgres import PostgresServer, new_database
from tests.fixtures.server.processes import client
from tests.fixtures.server.pushes import pushed
from tests.fixtures.server.service_user import service_user

__all__ = ["ended"]
pytestmark = [pytest.mark.processes, pytest.mark.slow]
COMMITS = [pushed(n, n) for n in range(3)]


def test_a_server_that_only_folds_compiles_before_it_says_that_it_is_ready(
    newest_postgres: PostgresServer, tmp_path: Path
) -> None:
    url = new_database(newest_postgres).url
    with service_user(tmp_path, kernels=False) as user:
        process = user.start("--store", url, "--fold-only")
        with client(process) as http:
            assert http.get("/healthz").status_code == 200
            answer = http.get("/readyz")
            assert answer.status_code == 503
            assert re.fullmatch(r"compiling: \d+ of \d+, \d+ s", answer.json()["detail"])
            assert "cairn_ready 0.0\n" in http.get("/metrics").text
            until(lambda: bool(list((user.data / "kernels").rglob("*.nbc"))), "a kernel is kept")
        process.send(signal.SIGTERM)
        code, said = process.end()
    assert code == 0 and "compiling kernels, once for this version: 0 of " in said and "Traceback" not in said, said


def test_once_it_is_ready_it_folds_with_the_kernels_that_are_kept_alone(
    newest_postgres: PostgresServer, tmp_path: Path, ended: list[Process]
) -> None:
    database = new_database(newest_postgres)
    url = served(tmp_path / "answers", database, ended, "--no-fold")
    push(url, *COMMITS)
    with service_user(tmp_path, kernels=True) as user:
        process = user.start("--store", database.url, "--fold-only")
        with client(process) as http:
            assert http.get("/readyz").status_code == 200
            until(lambda: folded(url, len(COMMITS)), "it folds what the other one took")
        process.send(signal.SIGTERM)
        assert process.end() == (0, "")
        assert not (user.data / "kernels").exists(), "something was compiled"
