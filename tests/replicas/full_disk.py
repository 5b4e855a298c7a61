"""A database whose disk is full: pushes are refused, and go on when there is room.

of the tables  a statement fails (507 `disk_full`), and the database goes on
of the log     the database ends, since it can promise nothing (503 `store_failed`), and has to be started again
"""

import random
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psycopg
from tests.fixtures.server.postgres import PostgresServer
from tests.fixtures.server.tiny_disk import TinyDisk, tiny_disk
from tests.replicas.fault_run import FaultRun, push_under_faults
from tests.replicas.site import Site

DISK_MB, LOG_DISK_MB, SEGMENT_MB = 192, 24, 1
FULL_S = 4.0
SPARE_SEGMENTS, SPARE_S = 20, 0.1
"""Files of the log that may be left to be written to, and the time in which something is written to each."""


def full_disk_run(folder: Path, programs: Path, *, what: str, seconds: float, robots: int, seed: int) -> FaultRun:
    """Fill the disk of the database's `tables`, or of its `log`, again and again."""
    chance, found = random.Random(seed), FaultRun()
    with tempfile.TemporaryDirectory(prefix="cairn-postgres-") as name:
        place = Path(name)
        place.chmod(0o755)  # the database's user has to enter it
        with tiny_disk(place / "disk", DISK_MB if what == "tables" else LOG_DISK_MB) as disk:
            postgres = _postgres(programs, place, disk, what)
            postgres.execute("CREATE DATABASE cairn")
            site = Site(folder, postgres, "cairn")
            site.add_all("server", "both")
            fault = (f"full disk of the {what}", _fill(postgres, disk, what))
            push_under_faults(site, found, [fault], chance, seconds=seconds, robots=robots)
            site.close()
            postgres.stop()
    return found


def _postgres(programs: Path, place: Path, disk: TinyDisk, what: str) -> PostgresServer:
    """A server with its tables or its log on a tiny disk, and all else on a large one."""
    large = place / "large"
    large.mkdir()
    here, there = (disk.folder, large) if what == "tables" else (large, disk.folder)
    postgres = PostgresServer(programs, here)
    postgres.move_log(there / "log", segment_mb=SEGMENT_MB)
    return postgres


def _fill(postgres: PostgresServer, disk: TinyDisk, what: str) -> Callable[[], None]:
    def act() -> None:
        disk.fill()
        if what == "log":
            with suppress(psycopg.OperationalError):
                for _ in range(SPARE_SEGMENTS):
                    postgres.execute("SELECT pg_switch_wal()")
                    threading.Event().wait(SPARE_S)
        threading.Event().wait(FULL_S)
        disk.make_room()
        postgres.revive()

    return act
