"""Faults of what shares a database and an object store, while everything that is folded moves there at once.

robots push --> database --> objects <-- readers of cells, at any server
                         killed, stopped, crashed, away

Cells come back with each fold and move again, objects die and are deleted within seconds, by whichever process settles.
"""

import random
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from tests.fixtures.server.deadline import until
from tests.fixtures.server.object_store import ObjectServer, object_server_in
from tests.fixtures.server.postgres import PostgresServer
from tests.replicas.fault_run import FaultRun, faults_of, postgres_in, push_under_faults
from tests.replicas.site import Site

from cairn_map.codec.cell_code import decode_cell
from cairn_map.errors import CairnError
from cairn_map.wire.messages import CellIndex

READERS = 2
AWAY_S = 2.0
AT_ONCE = "settle_cells_s = 0\nsettle_evidence_s = 0\nobjects_grace_s = 3\n"
"""Settings under which everything moves as soon as it is folded, and dead objects are deleted after 3 s: longer than
a reader takes."""
READ_PAUSE_S = 0.02
READ_LEAST = 50
"""Cells that are read in a run, however slow the machine is."""
EXPECTED = (200, 404, 503)
"""Statuses that a reader of a cell may get: it may not be there yet, or be away."""
COLD = """
    SELECT (SELECT count(*) FROM cell WHERE object IS NOT NULL), (SELECT count(*) FROM segment),
        (SELECT count(*) FROM dead_object)"""


def cold_run(folder: Path, programs: Path, *, seconds: float, robots: int, seed: int) -> FaultRun:
    """Push and read through servers that are killed, with an object store that goes away, and look at the store."""
    chance, found = random.Random(seed), FaultRun()
    with postgres_in(programs) as postgres, object_server_in() as objects:
        postgres.execute("CREATE DATABASE cairn")
        settings, place = folder / "settings.toml", objects.new_place()
        settings.write_text(AT_ONCE)
        bucket = objects.bucket(place)  # programs find it from here on, too
        site = Site(folder, postgres, "cairn", options=("--objects", place, "--settings", str(settings)))
        site.add_all("server", "server", "folder", "folder")
        faults = [*faults_of(site), ("object store away", _leave(objects))]
        chance.shuffle(faults)
        with _reading(site, found):
            push_under_faults(site, found, faults, chance, seconds=seconds, robots=robots, objects=bucket)
            until(lambda: found.reads["200"] >= READ_LEAST, "cells are read")
        # What failed while the object store was away is tried again, after a growing pause.
        until(lambda: min(_cold(postgres)[what] for what in ("cells", "segments")) > 0, "cells and evidence move there")
        found.cold = _cold(postgres)
        site.close()
    return found


def _leave(objects: ObjectServer) -> Callable[[], None]:
    """An object store that is killed, and comes back a moment later."""

    def act() -> None:
        objects.stop()
        threading.Event().wait(AWAY_S)
        objects.start()

    return act


def _cold(postgres: PostgresServer) -> dict[str, int]:
    ((cells, segments, dead),) = postgres.execute(COLD, "cairn")
    return {"cells": int(str(cells)), "segments": int(str(segments)), "objects out of use": int(str(dead))}


@contextmanager
def _reading(site: Site, found: FaultRun) -> Iterator[None]:
    """Readers of cells for the length of a `with`."""
    ended = threading.Event()
    threads = [threading.Thread(target=_read, args=(site, found, number, ended)) for number in range(READERS)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def _read(site: Site, found: FaultRun, number: int, ended: threading.Event) -> None:
    chance = random.Random(number)
    with httpx.Client(timeout=15.0) as http:
        while not ended.wait(READ_PAUSE_S):
            urls = site.urls()
            if not urls:
                continue
            try:
                said = _one_cell(http, f"{chance.choice(urls)}/maps/lab/main/cells", chance, found.pushed.wrong)
            except httpx.TransportError as exc:
                said = type(exc).__name__
            with found.pushed.lock:
                found.reads[said] += 1


def _one_cell(http: httpx.Client, url: str, chance: random.Random, wrong: list[str]) -> str:
    """Read a cell of the index, and note an answer that must not be."""
    listed = http.get(url)
    if not listed.is_success:
        return f"{listed.status_code} (index)"
    cells = CellIndex.model_validate_json(listed.content).cells
    if not cells:
        return "no cell yet"
    answer = http.get(f"{url}/{','.join(map(str, chance.choice(cells).cell))}")
    if answer.status_code not in EXPECTED:
        wrong.append(f"cell: {answer.status_code} {answer.text[:200]}")
    elif answer.is_success:
        try:
            if (digest := decode_cell(answer.content).digest.hex()) != answer.headers["ETag"].strip('"'):
                wrong.append(f"cell: its digest is {digest}, and its tag {answer.headers['ETag']}")
        except CairnError as exc:
            wrong.append(f"cell: {exc.message}")
    return str(answer.status_code)
