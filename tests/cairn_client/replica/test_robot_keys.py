"""A robot's keys: drawn with its incarnation, kept with it, and as secret as its token."""

import stat
from pathlib import Path

from tests.fixtures.client.made import MAP, A, committed, opened, seen

from cairn_client.replica.outbox import CommitFacts
from cairn_client.replica.replica_store import FILE_NAME
from cairn_map.commits.commit import Commit
from cairn_map.commits.signature import Signature, check_signatures, signatures_from_text, speaks_for

X = seen(1, 2)


def checked(commit: Commit, signatures: str | None) -> tuple[Signature, ...]:
    assert signatures is not None
    found = signatures_from_text(signatures)
    check_signatures(found, MAP, commit.sha)
    return found


def test_a_commit_is_signed_by_the_key_of_its_incarnation_after_a_restart_too(tmp_path: Path) -> None:
    mole = opened(tmp_path)
    commit = committed(mole, X)
    first = mole.outbox.signatures(commit)
    mole.close()
    again = opened(tmp_path)
    assert again.outbox.signatures(commit) == first
    assert speaks_for(checked(commit, first), commit.id.author)
    again.close()


def test_what_takes_back_from_an_older_incarnation_is_signed_by_both(tmp_path: Path) -> None:
    mole = opened(tmp_path)
    old = committed(mole, X)
    mole.outbox.new_incarnation("its disk was rolled back")
    amend = mole.commit({A: X}, CommitFacts(retracts=(old.id,)))
    signed = checked(amend, mole.outbox.signatures(amend))
    assert [speaks_for(signed, author) for author in (old.id.author, amend.id.author)] == [True, True]
    mole.close()


def test_a_new_key_is_vouched_for_by_the_first_and_older_commits_by_the_new_one(tmp_path: Path) -> None:
    mole = opened(tmp_path)
    commits = [committed(mole, X)]
    for _ in range(3):
        mole.outbox.new_incarnation("its disk was rolled back")
        commits.append(committed(mole, X))
    mole.close()
    again = opened(tmp_path)
    first, last = commits[0].id.author, commits[-1].id.author
    for commit in commits:
        signed = checked(commit, again.outbox.signatures(commit))
        own = {author for author in {first, last, commit.id.author} if speaks_for(signed, author)}
        assert own == {first, last, commit.id.author}
        assert len(signed) == len(own)
    again.close()


def test_a_folder_of_an_older_version_goes_on_in_a_new_incarnation_and_keeps_what_waits(tmp_path: Path) -> None:
    mole = opened(tmp_path)
    old = committed(mole, X)
    with mole.store.transaction():
        mole.store.put(f"signing_key.{old.id.author.incarnation}", None)
    mole.close()
    again = opened(tmp_path)
    new = committed(again, X)
    assert again.push_set() == [old.id, new.id]
    assert new.id.author != old.id.author and new.id.n == 0
    assert again.outbox.signatures(old) is None
    assert speaks_for(checked(new, again.outbox.signatures(new)), new.id.author)
    again.close()


def test_the_file_with_token_and_keys_is_its_user_s_alone(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).touch(0o644)
    mole = opened(tmp_path)
    committed(mole, X)
    files = [path for path in tmp_path.iterdir() if path.name.startswith(FILE_NAME)]
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o600}
    mole.close()


def test_a_new_folder_is_its_user_s_alone_and_one_that_was_there_stays_as_it_is(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "robots" / "mole"
    old.mkdir(0o755)
    for folder in (old, new):
        opened(folder).close()
    assert [stat.S_IMODE(folder.stat().st_mode) for folder in (old, new)] == [0o755, 0o700]
