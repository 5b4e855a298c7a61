"""Measurements that a command could not integrate again: a line for each group of them, and the command's exit code."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from cairn_client.cli.arguments import say
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, CairnError, NotFoundError

NOTE_MAX = 1024
"""Most characters of a commit's note."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftMeasurements:
    """Measurements of one folder that stay as they are, and why."""

    lost: Sequence[CommitId]
    """Measurements whose scans are not kept any more."""
    failed: Mapping[CommitId, CairnError]
    stopped: CairnError | None
    """Error that ended the work before its end; None: there was none."""


def say_left(left: LeftMeasurements) -> None:
    """Write a line for each group of measurements that could not be integrated again."""
    if left.lost:
        say(f"  the scans of {len(left.lost)} are not kept any more: {', '.join(_ranges(left.lost))}")
    for commit, exc in left.failed.items():
        say(f"  {commit} stays as it is: {exc.message} [{exc.kind}]")
    if left.stopped is not None:
        say(f"  stopped: {left.stopped.message} [{left.stopped.kind}]")


def raise_left(folders: Sequence[LeftMeasurements]) -> None:
    """Raise what the exit code is to say of a run that is over: the first error, else measurements without scans.

    Raises:
        CairnError: of the first folder or measurement that failed.
        NotFoundError: kind `no_scans`: the scans of some measurements are not kept.
    """
    errors = [left.stopped for left in folders if left.stopped is not None]
    errors += [exc for left in folders for exc in left.failed.values()]
    if errors:
        raise errors[0]
    lost = sum(len(left.lost) for left in folders)
    if lost:
        raise NotFoundError(
            "no_scans",
            f"{shown_measurements(lost)} cannot be integrated again: their scans are not kept, and they stay as they "
            "are. Keep more with --keep-scans, or take them out: cairn map retract --rig",
        )


def shown_measurements(count: int) -> str:
    """A number of measurements, in words."""
    return "1 measurement" if count == 1 else f"{count} measurements"


def check_note(note: str) -> None:
    """Refuse a note that is too long for a commit.

    Raises:
        BadInputError: kind `bad_meta`.
    """
    if len(note) > NOTE_MAX:
        raise BadInputError("bad_meta", f"a note has at most {NOTE_MAX} characters, got {len(note)}")


def _ranges(commits: Sequence[CommitId]) -> Iterator[str]:
    """Ids, those of a row as `mole.5f0c2a9be1d3f607.0-11`."""
    ordered = sorted(commits, key=lambda commit: (commit.author, commit.n))
    for _, group in groupby(enumerate(ordered), key=lambda item: (item[1].author, item[1].n - item[0])):
        row = [commit for _, commit in group]
        yield str(row[0]) if len(row) == 1 else f"{row[0]}-{row[-1].n}"
