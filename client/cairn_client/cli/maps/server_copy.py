"""`cairn map copy`: a map of one server on another one, with all its commits, such as from SQLite to PostgreSQL.

The map is made at the destination, and each commit goes there as it was pushed, with its signatures; attachments of
marks follow. Nothing stops meanwhile: what comes to the source later goes, too, with --follow until the command is
stopped. Repeated after any end it goes on where it was. With an admin's token at the destination all commits go:
unsigned ones, prior data and operators' retracts as well, which a relay's token cannot hand over for others.
"""

import argparse
import logging
import threading
import time
from dataclasses import dataclass, field, replace

from cairn_client.cli.arguments import Subparsers, add_map_parser, say, shown_bytes
from cairn_client.cli.maps.map_sides import Difference, MapSide, difference, side_of
from cairn_client.http.backoff import Backoff
from cairn_client.http.map_url import split_map_url
from cairn_client.http.origin_tokens import OriginTokens
from cairn_client.relay.carried_attachments import give_attachments
from cairn_client.relay.link import RelayApi, ServerEnd, hold_between
from cairn_client.relay.round import RelayReport, RelaySide, Undelivered, copy_round, log_report
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, CairnError, NotFoundError, UnreachableError
from cairn_map.progress import LOG_EVERY_S, TERMINAL_EVERY_S, StatusLine
from cairn_map.wire.messages import CreateMap
from cairn_map.wire.relay_peer import AttachmentEnd, Held, SignedCommit

COMPLETE, LACKING = 0, 1
EVERY_S = 5.0
CUTS_MAX = 6
"""Most rounds in a row that break without moving a commit; with --follow they go on."""
FOLD_S = 600.0
"""Longest wait for servers to fold what they have, before the maps are compared as they are."""
LOOK_S = 0.5


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    copy = add_map_parser(commands, "copy", _copy, text="copy a map to another server, all commits with it")
    copy.add_argument("to", metavar="URL", help="the same map at the other server, which is made if it is not there")
    copy.add_argument("--follow", action="store_true", help="go on with what comes later, until stopped")
    copy.add_argument(
        "--every", type=float, default=EVERY_S, metavar="SECONDS", help=f"pause between two looks ({EVERY_S:g})"
    )


def _copy(args: argparse.Namespace) -> int:
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    tokens: OriginTokens = args.token.bound_to(args.map)
    (source_url, name), (target_url, other) = split_map_url(args.map), split_map_url(args.to)
    if name != other:
        raise BadInputError(
            "bad_url", f"the copy of map {name} has to be named {name}, not {other}: its robots signed for that name"
        )
    with (
        RelayApi(source_url, token=tokens.of(source_url)) as source,
        RelayApi(target_url, token=tokens.of(target_url)) as target,
    ):
        _make_map(source, target, name)
        copy = _Copy(args.map, args.to, _Source(ServerEnd(source, name)), _Target(ServerEnd(target, name)), tokens)
        return copy.follow(args.every) if args.follow else copy.once()


def _make_map(source: RelayApi, target: RelayApi, name: str) -> None:
    info = source.map_info(name)
    try:
        there = target.map_info(name)
    except NotFoundError:
        wanted = CreateMap(geometry=info.geometry, sensor_model=info.sensor_model, epoch_s=info.epoch_s)
        there = target.create_map(name, wanted)
    if (there.geometry, there.sensor_model) != (info.geometry, info.sensor_model):
        raise BadInputError("other_geometry", f"map {name} is {info.geometry} here and {there.geometry} there")
    if there.epoch_s != info.epoch_s:
        here, other = (f"epochs of {end.epoch_s} s" if end.epoch_s else "no epochs" for end in (info, there))
        raise BadInputError("other_geometry", f"map {name} has {here} here and {other} there: they cannot be added")


@dataclass(slots=True)
class _Source:
    """The map that is copied: its commits are counted as they come."""

    end: AttachmentEnd
    commits: int = 0
    size_bytes: int = 0
    begun_s: float = field(default_factory=time.monotonic)
    total: int = 0
    """Commits that are to be copied, as far as is known."""
    _line: StatusLine = field(default_factory=StatusLine)
    _next_s: float = 0.0

    def held(self) -> Held:
        return self.end.held()

    def commit(self, commit: CommitId) -> SignedCommit:
        found = self.end.commit(commit)
        self.commits += 1
        self.size_bytes += len(found.data)
        self._show()
        # To a round, which is a relay's, an unsigned commit is one that stays; an admin may bring it all the same.
        return replace(found, signatures=found.signatures or "")

    def push(self, commit: SignedCommit) -> None:
        raise TypeError("a copy goes one way")

    def _show(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + (TERMINAL_EVERY_S if self._line.is_terminal else LOG_EVERY_S)
            speed = shown_bytes(self.size_bytes / max(now_s - self.begun_s, 1e-3))
            done = f"{self.commits} of {max(self.total, self.commits)} commits"
            self._line.show(f"{done}, {shown_bytes(self.size_bytes)}, {speed}/s")

    def clear(self) -> None:
        """Take the line of progress away."""
        self._line.clear()


@dataclass(slots=True)
class _Target:
    """The copy."""

    end: AttachmentEnd

    def held(self) -> Held:
        return self.end.held()

    def commit(self, commit: CommitId) -> SignedCommit:
        return self.end.commit(commit)

    def push(self, commit: SignedCommit) -> None:
        self.end.push(replace(commit, signatures=commit.signatures or None))


@dataclass(slots=True)
class _Copy:
    """A copy under way."""

    source_url: str
    target_url: str
    source: _Source
    target: _Target
    tokens: OriginTokens
    _resting: Undelivered = field(default_factory=Undelivered)
    _backoff: Backoff = field(default_factory=Backoff)

    def once(self) -> int:
        """Copy what there is, and compare both maps once they are folded."""
        report = self._all_handed_over()
        self.source.clear()
        size = shown_bytes(self.source.size_bytes)
        say(f"{report.moved[RelaySide.THERE]} commits copied, {size}")
        end_s = time.monotonic() + FOLD_S
        while True:
            found, sides = self._compared()
            if (found.is_equal and not found.commits_only_a) or self._are_folded(sides) or time.monotonic() > end_s:
                break
            threading.Event().wait(LOOK_S)
        return _show(found, sides)

    def follow(self, every_s: float) -> int:
        """Copy what there is and what comes, and say each time that both maps have become equal; until stopped."""
        was_equal = False
        try:
            while True:
                if self._round_of_follower() or not was_equal:
                    found, sides = self._compared()
                    was_equal = found.is_equal and not found.commits_only_a
                    if was_equal:
                        self.source.clear()
                        _show(found, sides)
                threading.Event().wait(every_s)
        except KeyboardInterrupt:
            self.source.clear()
            return _show(*self._compared())

    def _round_of_follower(self) -> int:
        while True:
            try:
                return self._all_handed_over().moved[RelaySide.THERE]
            except UnreachableError as exc:
                wait_s = self._backoff.next_s(exc.retry_after_s)
                self.source.clear()
                logging.getLogger(__name__).warning("%s; trying again in %.1f s", exc.message, wait_s)
                threading.Event().wait(wait_s)

    def _all_handed_over(self) -> RelayReport:
        """Rounds until the target has all that the source can give; the sum of their reports."""
        total, cuts = RelayReport(has_more=True), 0
        lacking = self.source.held().vector.minus(self.target.held().vector)
        self.source.total = self.source.commits + len(lacking)
        while total.has_more:
            report = hold_between(copy_round(self._resting), self.source, self.target)
            log_report(report, split_map_url(self.target_url)[1], there=self.target_url)
            moved = report.moved[RelaySide.THERE]
            total.moved[RelaySide.THERE] += moved
            total.has_more = report.has_more
            error: CairnError | None = report.cut or report.later
            if error:
                cuts = 0 if moved else cuts + 1
                if cuts == CUTS_MAX:
                    raise error
                threading.Event().wait(self._backoff.next_s(report.later.retry_after_s if report.later else None))
                total.has_more = True
            elif moved:
                self._backoff.reset()
        while give_attachments(self.source.end, self.target.end):
            pass
        return total

    def _compared(self) -> tuple[Difference, tuple[MapSide, MapSide]]:
        sides = side_of(self.source_url, tokens=self.tokens), side_of(self.target_url, tokens=self.tokens)
        return difference(*sides), sides

    def _are_folded(self, sides: tuple[MapSide, MapSide]) -> bool:
        """True if both maps show all that their servers hold."""
        held = (self.source.held().vector, self.target.held().vector)
        return all(
            side.commits is None or not len(vector.minus(side.commits))
            for side, vector in zip(sides, held, strict=True)
        )


def _show(found: Difference, sides: tuple[MapSide, MapSide]) -> int:
    """Say how the two maps compare; the exit code: whether the copy lacks anything."""
    source, target = sides
    if found.is_equal and not found.commits_only_a:
        count = len(source.commits or ())
        say(f"equal: {len(source.cells)} cells, {source.voxels} voxels, {count} commits, by digest")
        return COMPLETE
    if not found.commits_only_a and found.commits_only_b:
        say(f"all there: {len(source.commits or ())} commits, and {found.commits_only_b} more that came there")
        return COMPLETE
    cells = f"{len(found.only_a)} cells are missing there, {len(found.only_b)} missing here, {len(found.other)} differ"
    commits = f"{found.commits_only_a} commits only in {source.name}, {found.commits_only_b} in {target.name}"
    say(f"not equal: {cells}; {commits}")
    return LACKING
