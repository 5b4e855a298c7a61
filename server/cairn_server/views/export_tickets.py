"""Tickets for exports: a browser that saves a file follows a link, and can show no token there.

    POST .../export/tickets  -- asked, counted, laid aside -->  ticket
    GET .../export?QUERY&ticket=TICKET  -->  the file, once, within half a minute

Addresses stay in lists of downloads and logs of proxies, so no token may stand in them; a ticket that was shown is
worth nothing any more. The file is made ready with the ticket (`map_exports`): whatever can be wrong with it is said
to who asks, and not to a link. In memory only, by the ticket's hash.

Where several servers share a store, a note of the ticket is there, and taken once: another server than the one that
gave it makes the file when the ticket is shown.
"""

import secrets
import threading
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial

from cairn_map.errors import DeniedError, UnreachableError
from cairn_map.files.export_request import ExportRequest, ExportTicket
from cairn_server.access.auth import READING, TokenHolders, require, token_hash
from cairn_server.store.replica_notes import TicketNote
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow
from cairn_server.views.map_exports import Export, MapExports, while_allowed

TICKET_BYTES = 16
TICKET_S = 30.0
TICKETS_MAX = 32
"""Each has laid the cells of an export aside on the disk."""
TICKETS_OF_TOKEN_MAX = 4


@dataclass(frozen=True, slots=True)
class _Ticket:
    row: MapRow
    asked: ExportRequest
    holder: bytes | None
    """Hash of the token; None: none was shown."""
    export: Export
    until_s: float
    """By the steady clock."""
    timer: threading.Timer
    """Drops the file if no client comes for it."""


class ExportTickets:
    """Tickets that were given and not shown yet; thread-safe."""

    def __init__(self, store: Store, holders: TokenHolders, exports: MapExports) -> None:
        self._store = store
        self._holders = holders
        self._exports = exports
        self._notes = store.replicas.tickets if store.replicas is not None else None
        self._lock = threading.Lock()
        self._kept: dict[bytes, _Ticket] = {}
        self._of_token: Counter[bytes | None] = Counter()
        """Tickets kept, and those whose files are being made ready."""

    def give(self, row: MapRow, asked: ExportRequest, token: str | None) -> ExportTicket:
        """A ticket for exactly this file, of the map as it is now, to who shows a token (None: the server is open).

        Raises:
            UnreachableError: kind `too_many_tickets`.
            CairnError: what `MapExports.asked` raises.
        """
        holder = None if token is None else token_hash(token)
        self._take_place(holder)
        try:
            export = self._exports.asked(row, asked)
        except BaseException:
            self._leave_place(holder)
            raise
        ticket = secrets.token_hex(TICKET_BYTES)
        key = token_hash(ticket)
        timer = threading.Timer(TICKET_S, self._end, [key])
        timer.daemon = True
        with self._lock:
            until_s = time.monotonic() + TICKET_S
            self._kept[key] = _Ticket(row, asked, holder, export, until_s, timer)
        timer.start()
        if self._notes is not None:
            try:
                self._notes.put(key, TicketNote(row.name, asked.model_dump_json(), holder), lifetime_s=TICKET_S)
            except BaseException:
                self._end(key)
                raise
        ends_s = time.time() + TICKET_S
        return ExportTicket(ticket=ticket, ends_s=ends_s, points=export.count, size_bytes=export.size_bytes)

    def shown(self, ticket: str, name: str, asked: ExportRequest) -> Export:
        """The file of a ticket, which is worth nothing from now on, whatever comes of it.

        Raises:
            DeniedError: kind `bad_ticket`: unknown, over, or for another map or file; `bad_token`: the
                token that asked for it may not read the map any more.
        """
        key = token_hash(ticket)
        kept = self._taken_out(key)
        note = None
        try:
            if self._notes is not None:
                # One server gets it, though all are shown it: the one that gave the ticket, too, asks for it here.
                note = self._notes.take(key)
                if note is None:
                    raise _bad_ticket()
            if kept is None:
                return self._made_now(note, name, asked)
            if time.monotonic() >= kept.until_s or (kept.row.name, kept.asked) != (name, asked):
                raise _bad_ticket()
            self._check_token(kept.holder, kept.row)
        except BaseException:
            if kept is not None:
                kept.export.close()
            raise
        return while_allowed(kept.export, partial(self._check_token, kept.holder, kept.row))

    def _made_now(self, note: TicketNote | None, name: str, asked: ExportRequest) -> Export:
        """The file of a ticket that another server of the store gave."""
        if note is None or (note.map_name, ExportRequest.model_validate_json(note.asked)) != (name, asked):
            raise _bad_ticket()
        row = self._store.map(name)
        self._check_token(note.holder, row)
        return while_allowed(self._exports.asked(row, asked), partial(self._check_token, note.holder, row))

    def _check_token(self, holder: bytes | None, row: MapRow) -> None:
        require(self._holders.of_hash(holder, row), *READING)

    def close(self) -> None:
        """End all tickets."""
        for key in list(self._kept):
            self._end(key)

    def _end(self, key: bytes) -> None:
        kept = self._taken_out(key)
        if kept is not None:
            kept.export.close()

    def _taken_out(self, key: bytes) -> _Ticket | None:
        with self._lock:
            return self._pop(key)

    def _pop(self, key: bytes) -> _Ticket | None:
        """Take a ticket out, and free its place; the lock is held."""
        kept = self._kept.pop(key, None)
        if kept is not None:
            kept.timer.cancel()
            self._forget(kept.holder)
        return kept

    def _drop_taken(self) -> None:
        """Drop the files of tickets that were shown to other servers of the store."""
        with self._lock:
            keys = list(self._kept)
        if self._notes is not None and keys:
            for key in set(keys) - self._notes.left(keys):
                self._end(key)

    def _take_place(self, holder: bytes | None) -> None:
        with self._lock:
            is_tight = self._of_token[holder] >= TICKETS_OF_TOKEN_MAX or self._of_token.total() >= TICKETS_MAX
        if is_tight:
            self._drop_taken()
        with self._lock:
            own = self._of_token[holder]
            is_full = self._of_token.total() >= TICKETS_MAX
            gone = self._oldest_of_most(own) if is_full and own < TICKETS_OF_TOKEN_MAX else None
            if own >= TICKETS_OF_TOKEN_MAX or (is_full and gone is None):
                raise UnreachableError(
                    "too_many_tickets",
                    f"at most {TICKETS_OF_TOKEN_MAX} downloads that did not begin yet for one token and {TICKETS_MAX} "
                    f"in all; each waits {TICKET_S:g} s",
                    retry_after_s=TICKET_S,
                )
            ended = self._pop(gone) if gone is not None else None
            self._of_token[holder] += 1
        if gone is not None and ended is not None:
            ended.export.close()
            if self._notes is not None:
                self._notes.take(gone)

    def _oldest_of_most(self, own: int) -> bytes | None:
        """The oldest ticket of the token that has most, if it still has more than the newcomer then has.

        A robot has a token on each of its maps: of eight maps it would have all tickets.
        """
        kept = Counter(each.holder for each in self._kept.values())
        most = max(kept.values(), default=0)
        if most <= own + 1:
            return None
        return next(key for key, each in self._kept.items() if kept[each.holder] == most)

    def _leave_place(self, holder: bytes | None) -> None:
        with self._lock:
            self._forget(holder)

    def _forget(self, holder: bytes | None) -> None:
        self._of_token[holder] -= 1
        self._of_token += Counter()  # drops zeros: else every token ever seen would stay


def _bad_ticket() -> DeniedError:
    return DeniedError(
        "bad_ticket",
        f"the ticket is wrong, was used, ended ({TICKET_S:g} s), or is for another map or file; ask for another one",
    )
