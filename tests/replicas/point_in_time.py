"""A restore to a point in time under servers and robots that go on, by the very commands of docs/scale.md.

robots map   |---------------------------------------|              |-----------|  all maps are compared
database     |-- base backup --|-- T --|-------------|  restored to T  |
log archive  |---------------------------------------|
objects      |-------------------------------------------------- adopted --------|  all of them are read
"""

import re
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.fixtures.pages import DOCS
from tests.fixtures.server.deadline import until
from tests.fixtures.server.object_store import ObjectServer
from tests.fixtures.server.postgres import PostgresServer
from tests.replicas.fault_run import postgres_in
from tests.replicas.lost_tail import make_map
from tests.replicas.mappers import mapping, settle
from tests.replicas.site import Site

from cairn_map.errors import DamagedDataError
from cairn_server.operations.serve import main as serve

NAME = "lab"
ROBOTS = 3
REFILL_MAX_S = 600.0
SECTION = re.compile(r"^### Restore to a point in time\n(.*?)(?=^##)", re.MULTILINE | re.DOTALL)
BLOCK = re.compile(r"(?:^ {4}.*\n)+", re.MULTILINE)


@dataclass(slots=True)
class Restore:
    """What came of a run."""

    acked: int = 0
    before: int = 0
    """Commits in the database before the restore."""
    left: int = 0
    """Commits in it at the point in time."""
    restored_s: float = 0.0
    """Time from the stop of the database until it took commits."""
    refilled_s: float = 0.0
    """Time from there until all maps were equal."""
    answers: Counter[str] = field(default_factory=Counter)
    misfits: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    @property
    def is_sound(self) -> bool:
        """True if the robots brought back all that the restore took away."""
        return not (self.misfits or self.wrong) and self.left < self.before and self.refilled_s < REFILL_MAX_S

    def rows(self) -> Iterator[tuple[str, str]]:
        """Lines for people."""
        yield "acknowledged", f"{self.acked}"
        yield "rounds", ", ".join(f"{count} x {kind}" for kind, count in sorted(self.answers.items()))
        yield "commits before, at the point in time", f"{self.before}, {self.left}"
        yield "database restored in, all maps equal after", f"{self.restored_s:.1f} s, {self.refilled_s:.1f} s"
        yield "wrong", f"{self.misfits[:5] + self.wrong[:10]}"


@dataclass(frozen=True, slots=True)
class Commands:
    """Blocks of the page."""

    settings: tuple[str, ...]
    back_up: str
    restore: str
    """Without the last command, which starts the database."""


def commands_of_page() -> Commands:
    """Commands of the section about a restore to a point in time."""
    section = SECTION.search((DOCS / "scale.md").read_text())
    assert section is not None
    settings, back_up, restore = ([line[4:] for line in block.splitlines()] for block in BLOCK.findall(section[1]))
    assert restore[-1].startswith("pg_ctl start")
    named = tuple(re.sub(r" = '?(.*?)'?$", r"=\1", line) for line in settings)
    return Commands(named, "\n".join(back_up), "\n".join(restore[:-1]))


def restore_run(
    folder: Path, programs: Path, *, seconds: float, seed: int = 0, objects: ObjectServer | None = None
) -> Restore:
    """Let robots map for some seconds before and after a point in time, and restore it.

    With an object store all that is folded moves there at once, before and after.
    """
    found, backup = Restore(), Path(tempfile.mkdtemp(prefix="cairn-backup-"))
    page = commands_of_page()
    backup.chmod(0o777)
    (backup / "log").mkdir()
    (backup / "log").chmod(0o777)
    try:
        with postgres_in(programs, *(_here(setting, backup) for setting in page.settings)) as postgres:
            postgres.execute("CREATE DATABASE cairn")
            place = _place_in(objects) if objects is not None else None
            site = Site(folder, postgres, "cairn", options=_cold_options(folder, place))
            site.add_all("server", "both")
            make_map(site, NAME)
            with mapping(folder / "robots", site.urls, NAME, robots=ROBOTS, seed=seed) as (team, mappers):
                threading.Event().wait(seconds)
                postgres.shell(_here(page.back_up, backup))
                threading.Event().wait(seconds)
                ((then,),) = postgres.execute("SELECT clock_timestamp()::text")
                threading.Event().wait(seconds)
                found.before, start_s = _commits(postgres), time.monotonic()
                postgres.shell(_here(page.restore, backup, time=str(then)))
                postgres.start()
                found.left = _commits(postgres)
                until(lambda: postgres.execute("SELECT pg_is_in_recovery()") == [(False,)], "it takes commits")
                found.restored_s = time.monotonic() - start_s
                if place is not None:
                    assert serve(["adopt", "--store", postgres.url("cairn"), "--objects", place]) == 0
                threading.Event().wait(seconds)
                found.refilled_s = seconds + settle(site.urls(), NAME, team, mappers)
            if place is not None:
                found.wrong += _of_objects(postgres, place)
            site.close()
    finally:
        shutil.rmtree(backup)
    found.acked, found.answers = len(team.acked), team.answers
    found.misfits, found.wrong = team.misfits, team.wrong
    return found


def _place_in(objects: ObjectServer) -> str:
    place = objects.new_place()
    objects.bucket(place)  # programs find it from here on
    return place


def _cold_options(folder: Path, place: str | None) -> tuple[str, ...]:
    """Options under which bytes move as soon as they are folded, and objects stay for longer than a run."""
    if place is None:
        return ()
    settings = folder / "settings.toml"
    settings.write_text("settle_cells_s = 0\nsettle_evidence_s = 0\n")
    return "--objects", place, "--settings", str(settings)


def _of_objects(postgres: PostgresServer, place: str) -> Iterator[str]:
    """What is wrong where bytes are in an object store: damage, or that none moved since the restore."""
    query = "SELECT count(*) FROM diff WHERE body IS NOT NULL"
    until(lambda: postgres.execute(query, "cairn") == [(0,)], "all evidence moved to the object store again")
    try:
        serve(["check", "--store", postgres.url("cairn"), "--objects", place])
    except DamagedDataError as exc:
        yield exc.message


def _here(command: str, backup: Path, *, time: str = "") -> str:
    """A command of the page with the places of this run."""
    command = command.replace("/backup", str(backup)).replace("postgresql://cairn@database/cairn", "$URL")
    return re.sub(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\+00", time, command)


def _commits(postgres: PostgresServer) -> int:
    ((count,),) = postgres.execute("SELECT count(*) FROM commits", "cairn")
    assert isinstance(count, int)
    return count
