"""A folder of others' commits: whole or not there, bounded, and true about what it has."""

from pathlib import Path

import pytest
from tests.cairn_client.made import foreign

from cairn_client.carried import COMING, CarriedCommits
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError
from cairn_map.relay_end import SignedCommit
from cairn_map.signature import TEXT_MAX

ROOM = 1000


def signed(n: int, size_bytes: int = 300) -> SignedCommit:
    return SignedCommit(foreign(n), b"\n" * size_bytes, "aa.bb")


@pytest.fixture
def carried(tmp_path: Path) -> CarriedCommits:
    return CarriedCommits(tmp_path / "carried", size_bytes_max=ROOM)


def test_what_is_put_in_comes_out_after_a_restart_too(carried: CarriedCommits, tmp_path: Path) -> None:
    carried.push(signed(0))
    carried.push(signed(0))
    again = CarriedCommits(tmp_path / "carried", size_bytes_max=ROOM)
    assert list(again.held().vector) == [foreign(0)]
    assert again.commit(foreign(0)) == signed(0)
    with pytest.raises(NotFoundError):
        again.commit(foreign(1))


def test_when_it_is_full_the_oldest_give_way_and_are_not_fetched_again(carried: CarriedCommits, tmp_path: Path) -> None:
    for n in range(5):
        carried.push(signed(n))
        sizes = [path.stat().st_size for path in (tmp_path / "carried").iterdir()]
        assert sum(sizes) <= ROOM
    assert list(carried.held().vector) == [foreign(n) for n in range(5)]
    with pytest.raises(ConflictError) as gone:
        carried.commit(foreign(1))
    assert gone.value.kind == "evidence_gone"
    assert [carried.commit(foreign(n)) for n in (2, 3, 4)] == [signed(n) for n in (2, 3, 4)]


def test_a_file_that_is_not_whole_is_none(carried: CarriedCommits, tmp_path: Path) -> None:
    carried.push(signed(0))
    (tmp_path / "carried" / f"{foreign(1)}{COMING}").write_bytes(b"aa.bb\nhalf")
    (tmp_path / "carried" / "notes.txt").write_text("of people")
    assert list(carried.held().vector) == [foreign(0)]
    (tmp_path / "carried" / str(foreign(0))).write_bytes(b"x" * (TEXT_MAX + 1))
    with pytest.raises(DamagedDataError):
        carried.commit(foreign(0))


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInputError, match="file"):
        CarriedCommits(tmp_path / "file" / "carried", size_bytes_max=ROOM)
