"""Short runs of `tests.replicas`: faults of servers, a link, a disk, an object store, and the verdict on the store."""

from pathlib import Path

import pytest
from tests.fixtures.server.postgres import SYSTEM, WHEEL, programs_of
from tests.replicas.cold_run import cold_run
from tests.replicas.cut_link import cut_link_run
from tests.replicas.fault_run import fault_run
from tests.replicas.full_disk import full_disk_run

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.mark.parametrize(("kind", "seed"), [(WHEEL, 1), (SYSTEM, 4)])
def test_nothing_that_was_acknowledged_is_lost_or_folded_twice(kind: str, seed: int, tmp_path: Path) -> None:
    found = fault_run(tmp_path, programs_of(kind), seconds=8.0, robots=3, seed=seed)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound and len(found.pushed.acked) > 50, said


def test_nothing_is_lost_on_its_way_to_an_object_store_that_goes_away(tmp_path: Path) -> None:
    found = cold_run(tmp_path, programs_of(WHEEL), seconds=9.0, robots=2, seed=2)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
    assert found.cold["cells"] and found.cold["segments"] and found.reads["200"] > 20, said


def test_a_server_that_is_cut_off_from_the_database_says_so_and_works_again(tmp_path: Path) -> None:
    found = cut_link_run(tmp_path, programs_of(WHEEL), seconds=6.0, robots=2, seed=1)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
    assert found.pushed.answers["503 store_failed"] > 5 and len(found.pushed.acked) > 50, said


def test_a_full_disk_of_the_database_refuses_commits_until_there_is_room(tmp_path: Path) -> None:
    found = full_disk_run(tmp_path, programs_of(WHEEL), what="tables", seconds=4.0, robots=2, seed=1)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
    assert found.pushed.answers["507 disk_full"] > 5 and len(found.pushed.acked) > 20, said
