"""A folder of others' commits: whole or not there, bounded, and true about what it has."""

from dataclasses import replace
from pathlib import Path

import pytest
from tests.fixtures.client.made import MAP
from tests.fixtures.server.pushes import pushed

from cairn_client.relay.carried_commits import CarriedCommits
from cairn_client.replica.durable_file import COMING
from cairn_map.commits.ids import Author, CommitId, RobotName
from cairn_map.commits.signature import TEXT_MAX, SigningKey, signatures_to_text
from cairn_map.errors import BadInputError, ConflictError, DamagedDataError, NotFoundError, UnreachableError
from cairn_map.wire.relay_peer import SignedCommit

KEY = SigningKey(bytes(32))
AUTHOR = Author(RobotName("other"), KEY.incarnation)


def id_of(n: int) -> CommitId:
    return CommitId(AUTHOR, n)


def signed(n: int, *, key: SigningKey = KEY, map_name: str = MAP, seed: int = 0) -> SignedCommit:
    commit = pushed(n, seed, AUTHOR)
    return SignedCommit(commit.id, commit.data, signatures_to_text([key.sign(map_name, commit.sha)]))


ROOM = 3 * (len(signed(0).data) + 300)
"""For three of them."""


@pytest.fixture
def carried(tmp_path: Path) -> CarriedCommits:
    return CarriedCommits(tmp_path / "carried", MAP, size_bytes_max=ROOM)


def test_what_is_put_in_comes_out_after_a_restart_too(carried: CarriedCommits, tmp_path: Path) -> None:
    carried.push(signed(0))
    carried.push(signed(0))
    again = CarriedCommits(tmp_path / "carried", MAP, size_bytes_max=ROOM)
    assert list(again.held().vector) == [id_of(0)]
    assert again.commit(id_of(0)) == signed(0)
    with pytest.raises(NotFoundError):
        again.commit(id_of(1))


def test_when_it_is_full_the_oldest_give_way_and_are_not_fetched_again(carried: CarriedCommits, tmp_path: Path) -> None:
    for n in range(5):
        carried.push(signed(n))
        sizes = [path.stat().st_size for path in (tmp_path / "carried").iterdir()]
        assert sum(sizes) <= ROOM
    assert list(carried.held().vector) == [id_of(n) for n in range(5)]
    with pytest.raises(ConflictError) as gone:
        carried.commit(id_of(1))
    assert gone.value.kind == "evidence_gone"
    assert [carried.commit(id_of(n)) for n in (2, 3, 4)] == [signed(n) for n in (2, 3, 4)]


def test_a_file_that_is_not_whole_is_none(carried: CarriedCommits, tmp_path: Path) -> None:
    carried.push(signed(0))
    (tmp_path / "carried" / f"{id_of(1)}{COMING}").write_bytes(b"aa.bb\nhalf")
    (tmp_path / "carried" / "notes.txt").write_text("of people")
    assert list(carried.held().vector) == [id_of(0)]
    (tmp_path / "carried" / str(id_of(0))).write_bytes(b"x" * (TEXT_MAX + 1))
    with pytest.raises(DamagedDataError):
        carried.commit(id_of(0))


def test_what_cannot_be_read_is_named(carried: CarriedCommits, tmp_path: Path) -> None:
    (tmp_path / "carried" / str(id_of(0))).mkdir()
    with pytest.raises(DamagedDataError, match=str(id_of(0))):
        carried.commit(id_of(0))
    (tmp_path / "carried").rename(tmp_path / "gone")
    with pytest.raises(UnreachableError, match="carried"):
        carried.held()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInputError, match="file"):
        CarriedCommits(tmp_path / "file" / "carried", MAP, size_bytes_max=ROOM)


@pytest.mark.parametrize(
    ("false", "kind"),
    [
        (signed(0, key=SigningKey(b"x" * 32)), "bad_signature"),
        (signed(0, map_name="other"), "bad_signature"),
        (replace(signed(0), data=signed(0, seed=1).data), "bad_signature"),
        (replace(signed(1), id=id_of(0)), "other_id"),
        (replace(signed(0), data=bytes(ROOM)), "too_large"),
    ],
)
def test_what_its_author_did_not_sign_or_has_no_room_is_not_kept_in_place_of_anything(
    carried: CarriedCommits, false: SignedCommit, kind: str
) -> None:
    carried.push(signed(1))
    with pytest.raises(BadInputError) as refused:
        carried.push(false)
    assert refused.value.kind == kind
    assert list(carried.held().vector) == [id_of(1)]
    assert carried.commit(id_of(1)) == signed(1)
    carried.push(signed(0))
    assert carried.commit(id_of(0)) == signed(0)
