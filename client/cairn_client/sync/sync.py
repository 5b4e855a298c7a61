"""One round with the server: push the commits that it may lack, fetch what is missing. A repeat changes nothing.

These are conversations (`requests`): generators that yield what to ask next, given what was answered. There is no I/O
except the replica's own.

high-end   push commits; frames that bring every held cell to the server's head
low-end    push commits; the index of cells; whole cells that changed, all or those near a place
viewer     fetch as high-end does; push nothing but the operator's retracts that a restored server lost
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from cairn_client.replica.replica import BAD_CLOCK, Replica
from cairn_client.replica.replica_store import BaseCell
from cairn_client.sync.exchange import Exchange, is_within
from cairn_client.sync.near_cells import Wanted, in_order
from cairn_client.sync.requests import (
    Box,
    Conversation,
    GetCell,
    GetCommit,
    GetMissing,
    GetView,
    NextFrame,
    Push,
    PutCell,
    whole_index,
)
from cairn_client.sync.uploads import PARTS, Parts, push_whole_or_in_parts
from cairn_map.codec.layer_code import decode_layer_cell, encode_layer_cell
from cairn_map.commits.commit import Commit
from cairn_map.commits.commit_reading import validated_commit
from cairn_map.commits.ids import Author, CommitId
from cairn_map.epochs.cell_history import history_fingerprint
from cairn_map.errors import (
    BadInputError,
    CairnError,
    ConflictError,
    DamagedDataError,
    DeniedError,
    UnreachableError,
)
from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import Cell, CellKey, cell_key, cell_of_key
from cairn_map.wire.frames import CellFrame

log = logging.getLogger(__name__)

ROUNDS_MAX = 64
"""Requests in one fetch: a reply may ask for another request, or for a comparison, but not for ever."""
REPLIES_MAX = 4096
"""Requests in one fetch, with those whose reply ends before its cells do, by a limit of bytes."""


@dataclass(slots=True)
class RoundReport:
    """Counts of one round's work."""

    pushed: int = 0
    """Commits that the server took."""
    refused: dict[CommitId, CairnError] = field(default_factory=dict)
    """Commits that the server will not take, and why; they stay in the outbox."""
    frames: int = 0
    """Frames that came; high-end and viewer."""
    cells_fetched: int = 0
    """Whole cells that came; low-end."""
    size_bytes: int = 0
    """Bytes of the cells that came."""
    has_more: bool = False
    """True if the round ended at its limit of bytes: the next one goes on."""
    healed: int = 0
    """Cells that the server had damaged and received from here."""
    waiting: int = 0
    """Own commits that the server lacks still: those that it refused, and those of a measurement since."""
    pending: int = 0
    """Own commits that the server has, and that its map does not hold yet; the next round may find them there."""

    @property
    def is_up_to_date(self) -> bool:
        """True if the server's map holds all commits of this robot, and the robot all that the map held then."""
        return not (self.has_more or self.waiting or self.pending)

    def add_pushes(self, pushes: "RoundReport") -> None:
        """Take over the counts of the round's pushes."""
        self.pushed, self.refused = pushes.pushed, pushes.refused


def push_commits(
    replica: Replica,
    *,
    sealed_only: bool = False,
    on_push: Callable[[CommitId], None] | None = None,
    parts: Parts = PARTS,
) -> Conversation[RoundReport]:
    """Push every commit that the server may lack, oldest first.

    Args:
        replica: the robot's state.
        sealed_only: True to push only the server's own retracts.
        on_push: called with each commit that the server has for good.
        parts: sizes of the parts in which large commits go.

    Raises:
        UnreachableError: the link broke; what was acknowledged before stays so.
        DeniedError: the server does not know this robot.
    """
    report = RoundReport()
    shut_out: set[Author] = set()  # by the server, which knows the robot by another key: one try a round
    # Oldest first, so that a commit is there before those that take it out.
    for commit_id in replica.push_set():
        # What was refused lately, and what is no longer here, is left out.
        if (refusal := replica.refusals.of(commit_id)) is not None:
            report.refused[commit_id] = refusal
            continue
        if commit_id.author in shut_out:
            continue
        commit, seal = replica.kept_commit(commit_id), replica.seal(commit_id)
        if commit is None or (sealed_only and seal is None):
            continue
        # A refusal of this commit must not hold up the others; a broken link or a bad token ends the round.
        try:
            pushed = yield from _push(replica, commit, seal, parts)
        except UnreachableError as exc:
            if exc.kind != BAD_CLOCK:
                raise
            # It keeps its epoch, since others may have it already: the server takes it once its time has come.
            log.warning("the server does not take commit %s yet: %s", commit_id, exc.message)
            report.refused[commit_id] = exc
            replica.refusals.note(commit_id, exc)
            continue
        except ConflictError as exc:
            log.error("the server will not take commit %s: %s: %s", commit_id, exc.kind, exc.message)
            report.refused[commit_id] = exc
            replica.refusals.note(commit_id, exc)
            continue
        except DeniedError as exc:
            if exc.kind not in ("not_allowed", "not_admitted"):  # the token is not good: no fault of the commit
                raise
            log.error("the server refuses commit %s: %s", commit_id, exc.message)
            report.refused[commit_id] = exc
            if exc.kind == "not_admitted":
                shut_out.add(commit_id.author)
            continue
        except (BadInputError, DamagedDataError) as exc:  # it must not hold up all that come after it
            log.error("the server refuses commit %s: %s: %s", commit_id, exc.kind, exc.message)
            report.refused[commit_id] = exc
            replica.refusals.note(commit_id, exc)
            continue
        # Durable on the server, but perhaps in no cell yet: only coverage lets the bytes go here (rule 12).
        replica.acknowledge(pushed)
        report.pushed += 1
        if on_push:
            on_push(pushed)
    return report


def _push(replica: Replica, commit: Commit, seal: str | None, parts: Parts) -> Conversation[CommitId]:
    """Push one commit; its id, which is a new one if the server has other bytes under the old one (rule 13).

    It gets a new one, too, if an administrator closed the incarnation.
    """
    try:
        yield from push_whole_or_in_parts(_signed(replica, commit, seal), parts)
    except ConflictError as exc:
        if exc.kind == "evidence_gone":
            # The server forgot the commits that this one takes out: it takes their bytes from any robot (rule 11).
            for target in commit.meta.retracted_ids:
                if (kept := replica.kept_commit(target)) is not None:
                    yield from push_whole_or_in_parts(_signed(replica, kept), parts)
            yield from push_whole_or_in_parts(_signed(replica, commit, seal), parts)
            return commit.id
        # Other bytes under an own id: this disk was rolled back (rule 13). Or an administrator closed the author, which
        # takes nothing new; what the server once had, another server may have under its id. A server's own retract
        # cannot be renamed.
        entry = replica.outbox.kept(commit.id)
        is_closed = exc.kind == "author_closed" and entry is not None and not entry.acked
        if not (is_closed or exc.kind == "id_taken") or seal is not None:
            raise
        renamed = replica.kept_commit(replica.rename(commit.id))
        assert renamed is not None  # noqa: S101 - it was just kept
        yield from push_whole_or_in_parts(_signed(replica, renamed), parts)
        return renamed.id
    return commit.id


def _signed(replica: Replica, commit: Commit, seal: str | None = None) -> Push:
    return Push(commit, seal, replica.signatures(commit))


def keep_retracts(replica: Replica) -> Conversation[None]:
    """Fetch and keep the operator's retracts until no restore of the server can lose them (SYNC.md rule 11).

    Raises:
        UnreachableError: the link broke; the others are fetched next time.
    """
    for commit_id in replica.lacking_retracts():
        try:
            data, seal = yield from GetCommit(commit_id)
            commit = validated_commit(data)
        except CairnError as exc:
            if isinstance(exc, UnreachableError | DeniedError):
                raise
            log.error("the operator's retract %s cannot be kept: %s", commit_id, exc.message)
            continue
        # Only with its seal does a server take it back, and an operator's retract has no evidence.
        if seal is not None and commit.id == commit_id and not commit.cells:
            replica.keep_sealed(commit, seal)


def heal_damaged(replica: Replica) -> Conversation[int]:
    """Send back the cells that the server's disk damaged, of those that are here as they were; how many were sent.

    The newest header names each cell and the fingerprint that it had; a base of that fingerprint is the cell. The
    server takes it for its SHA-256 alone, so no robot has to be trusted, and one that is wrong changes nothing.


    Raises:
        UnreachableError: the link broke; the others are sent next time.
        DeniedError: the server does not know this robot.
    """
    healed = 0
    for cell, wanted in replica.header.damaged if replica.header else []:
        key = cell_key(cell)
        body = None if (key, wanted) in replica.refusals.cells else _sound_body(replica, key, wanted)
        if body is None:
            continue
        # A refusal is about these very bytes: it is remembered, so that no later round sends them again.
        try:
            yield from PutCell(Cell(*cell), body)
        except (UnreachableError, DeniedError):
            raise
        except CairnError as exc:
            log.error("the server will not take cell %s, which it calls damaged: %s", Cell(*cell), exc.message)
            replica.refusals.cells.add((key, wanted))
        else:
            log.warning("the server had damaged cell %s; sent it from here", Cell(*cell))
            healed += 1
    return healed


def _sound_body(replica: Replica, key: CellKey, wanted: str) -> bytes | None:
    """Bytes of a cell as the server had it; None if another state is held, or the bytes here are damaged too."""
    with replica.changing() as base:
        held = base.cells.get(key)
        if held is None or held.fingerprint.hex() != wanted:
            return None
        history = base.history(key)
    # Outside the lock, because the sum takes long; the evidence was decoded for this call alone.
    if history_fingerprint(history, key, layer_word=replica.layer.word).hex() != wanted:
        return None
    return encode_layer_cell(key, history, replica.layer).data


def fetch_missing(
    replica: Replica,
    *,
    box: Box | None = None,
    reply_bytes_max: int | None = None,
    round_bytes_max: int | None = None,
    near: Cell | None = None,
) -> Conversation[RoundReport]:
    """Bring every held cell to the server's head, or those in a box; what arrives before a cut is kept.

    With `reply_bytes_max` a reply ends after so many bytes of cells, and the rest is asked for by the next request;
    with `round_bytes_max` that is left to the next round, so that commits need not wait. The cells next to `near`
    come first.

    Raises:
        UnreachableError: the link broke, or the server keeps asking to come back.
        DamagedDataError: the server's answer is not sound.
    """
    report = RoundReport()
    # Each turn asks for all that is still missing, until an answer brings all cells to the server's head.
    compare = False
    rounds = replies = 0
    while rounds < ROUNDS_MAX and replies < REPLIES_MAX:
        replies += 1
        exchange = Exchange(replica, compare=compare, box=box, reply_bytes_max=reply_bytes_max, near=near)
        try:
            frame = yield from GetMissing(exchange.request())
            while frame is not None:
                exchange.take(frame)
                report.frames += 1
                report.size_bytes += len(frame.payload) if isinstance(frame, CellFrame) else 0
                frame = yield from NextFrame()
        except ConflictError as exc:
            if exc.kind != "other_log":
                raise
            log.warning("another server answers for this map; starting without its old state")
            # Cursors and coverage of the old log prove nothing here; every commit is offered to the new one (rule 9).
            replica.forget_server()
            rounds += 1
            continue
        # Then the rest of the round: cells for the server, a complaint about damaged ones, and whether to ask again.
        report.healed += yield from heal_damaged(replica)
        _complain(exchange.damaged)
        compare = exchange.must_compare
        # A reply that ended at its limit of bytes brought cells, so it counts as a reply alone, not as a round.
        rounds += not exchange.has_more
        # A cell whose frame did not fit has lost its cursor, also where all others moved: ask once more.
        if exchange.is_done and not _has_unproven(replica, box):
            yield from keep_retracts(replica)
            return report
        if exchange.has_more and round_bytes_max is not None and report.size_bytes >= round_bytes_max:
            report.has_more = True
            return report
    raise UnreachableError("no_end", f"no end of the answer after {replies} requests", retry_after_s=30.0)


def fetch_present(replica: Replica, *, box: Box | None = None, near: Cell | None = None) -> Conversation[int]:
    """Show how all cells read now, before their rows come (rule S6); how many are shown.

    A view has a tenth of the bytes of one pass, however long the map's history is. A server that makes none, or a
    view that is not sound, costs only this: the rows come all the same.

    Raises:
        UnreachableError: the link broke.
    """
    index = yield from whole_index(replica.author, box=box)
    shown = 0
    for number in in_order(index.cells, near):
        key = CellKey(int(number))
        if replica.cell(key) is not None:
            continue
        try:
            data = yield from GetView(cell_of_key(key))
            with replica.changing() as base:
                base.show_view(key, data, replica.state.map_model())
            shown += 1
        except (UnreachableError, DeniedError):
            raise
        except CairnError as exc:
            log.warning("cell %s is not shown before its rows come: %s", cell_of_key(key), exc.message)
    return shown


def fetch_cells(
    replica: Replica,
    *,
    wanted: Wanted | None = None,
    box: Box | None = None,
    round_bytes_max: int | None = None,
    near: Cell | None = None,
) -> Conversation[RoundReport]:
    """Fetch the whole cells that changed since they were fetched last, for a low-end robot.

    All cells, or those in a box, or the wanted ones of it. The index states which changed, so that equal cells cost no
    request. Those next to `near` come first, and hot ones before others (`cell_order`).

    Raises:
        UnreachableError: the link broke; the cells before it are kept.
        DamagedDataError: some cells are damaged; all others came.
    """
    report = RoundReport()
    author = replica.author
    index = yield from whole_index(author, box=box, held=replica.header)
    to, coverage = index.header.to_cursor, index.header.coverage
    # What the index alone settles: cells that did not change move along, and cells that are gone are emptied.
    with replica.changing() as base:
        if replica.header and replica.header.to_cursor.log_id != to.log_id:
            log.warning("another server answers for this map; starting without its old state")
            replica.forget_server()
        replica.take_header(index.header, asked_by=author)
        # Equal bytes hold exactly the index's commits: cursor and coverage move without a request (rule 14).
        # Each page of the index is of a state of its own: a cell stamped beyond the first one's changed in between.
        listed = {key: index.cells.find(key) for key in base.cells}
        same = {
            key
            for key, entry in listed.items()
            if entry is not None and base.cells[key].etag == f'"{entry.digest}"' and entry.lm <= to.seq
        }
        base.move(same, to=to, coverage=coverage)
        for key, entry in listed.items():  # a server that was restored forgot those that it does not list
            if entry is None and is_within(key, box):
                base.hold_nothing(key, BaseCell(to, coverage, ZERO))
    report.healed = yield from heal_damaged(replica)
    # All other cells are fetched whole, the nearest first.
    damaged = []
    for number in in_order(index.cells, near):
        key = CellKey(int(number))
        if key in same:
            continue
        report.has_more = round_bytes_max is not None and report.size_bytes >= round_bytes_max
        if report.has_more:
            break
        if wanted is None or wanted(cell_of_key(key)):
            try:
                size_bytes = yield from fetch_cell(replica, cell_of_key(key))
                report.cells_fetched += size_bytes > 0
                report.size_bytes += size_bytes
            except DamagedDataError as exc:
                log.error("cell %s: %s", cell_of_key(key), exc.message)
                damaged.append(key)
    if not report.has_more:
        replica.forget_stable_commits(wanted=wanted)
        yield from keep_retracts(replica)
    _complain(damaged)
    return report


def fetch_cell(replica: Replica, cell: Cell) -> Conversation[int]:
    """Fetch one cell, if it changed, for a low-end robot; the size of its bytes.

    Raises:
        DamagedDataError: the cell does not have the fingerprint that the server states.
    """
    key = cell_key(cell)
    held = replica.cell(key)
    fetched = yield from GetCell(cell, held.etag if held else None)
    with replica.changing() as base:
        if fetched.body is None and held is not None:
            # An unchanged cell has a newer coverage all the same: own commits in it are no longer added (rule 14).
            base.move([key], to=fetched.cursor, coverage=fetched.coverage)
            return 0
        # It is held only if it is the cell that was asked for, with the fingerprint that the server states.
        history = decode_layer_cell(fetched.body or b"", key, replica.layer).history
        if history_fingerprint(history, key, layer_word=replica.layer.word) != fetched.fingerprint:
            raise DamagedDataError("fingerprint_mismatch", f"cell {cell} is not what the server says it is")
        cell_here = BaseCell(fetched.cursor, fetched.coverage, fetched.fingerprint, fetched.etag)
        base.hold(key, cell_here, history, body=fetched.body)
        return len(fetched.body or b"")


def _complain(damaged: Sequence[CellKey]) -> None:
    """Raises: DamagedDataError: if there are cells that came whole but not sound, or that the server could not send."""
    if damaged:
        names = ", ".join(str(cell_of_key(key)) for key in damaged)
        raise DamagedDataError("fingerprint_mismatch", f"the server's cells {names} are damaged; all others came")


def _has_unproven(replica: Replica, box: Box | None) -> bool:
    """True if a cell still waits to be fetched whole."""
    with replica.changing() as base:
        # Those that stand together have a proven cursor.
        return any(cell.cursor is None for key, cell in base.cells.apart.items() if is_within(key, box))
