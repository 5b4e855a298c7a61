"""Tickets for exports: a browser that saves a file follows a link, and can show no token there.

    POST .../export/tickets  -- asked, counted, laid aside -->  ticket
    GET .../export?QUERY&ticket=TICKET  -->  the file, once, within half a minute

Addresses stay in lists of downloads and logs of proxies, so no token may stand in them; a ticket that was shown is
worth nothing any more. The file is made ready with the ticket (`map_exports`): whatever can be wrong with it is said
to who asks, and not to a link. In memory only, by the ticket's hash.
"""

import secrets
import threading
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial

from cairn_map.errors import DeniedError, UnreachableError
from cairn_map.files.export_request import ExportRequest, ExportTicket
from cairn_server.access.auth import READING, caller_of, require, token_hash
from cairn_server.settings import Settings
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
    token: str | None
    export: Export
    until_s: float
    """By the steady clock."""
    timer: threading.Timer
    """Drops the file if no client comes for it."""


class ExportTickets:
    """Tickets that were given and not shown yet; thread-safe."""

    def __init__(self, store: Store, settings: Settings, exports: MapExports) -> None:
        self._store = store
        self._settings = settings
        self._exports = exports
        self._lock = threading.Lock()
        self._kept: dict[bytes, _Ticket] = {}
        self._of_token: Counter[bytes] = Counter()
        """Tickets kept, and those whose files are being made ready."""

    def give(self, row: MapRow, asked: ExportRequest, token: str | None) -> ExportTicket:
        """A ticket for exactly this file, of the map as it is now, to who shows a token (None: the server is open).

        Raises:
            UnreachableError: kind `too_many_tickets`.
            CairnError: what `MapExports.asked` raises.
        """
        holder = token_hash(token or "")
        self._take_place(holder)
        try:
            export = self._exports.asked(row, asked)
        except BaseException:
            self._leave_place(holder)
            raise
        ticket = secrets.token_hex(TICKET_BYTES)
        timer = threading.Timer(TICKET_S, self._end, [token_hash(ticket)])
        timer.daemon = True
        with self._lock:
            until_s = time.monotonic() + TICKET_S
            self._kept[token_hash(ticket)] = _Ticket(row, asked, token, export, until_s, timer)
        timer.start()
        ends_s = time.time() + TICKET_S
        return ExportTicket(ticket=ticket, ends_s=ends_s, points=export.count, size_bytes=export.size_bytes)

    def shown(self, ticket: str, name: str, asked: ExportRequest) -> Export:
        """The file of a ticket, which is worth nothing from now on, whatever comes of it.

        Raises:
            DeniedError: kind `bad_ticket`: unknown, over, or for another map or file; `bad_token`: the
                token that asked for it may not read the map any more.
        """
        kept = self._taken_out(token_hash(ticket))
        if kept is None:
            raise _bad_ticket()
        try:
            if time.monotonic() >= kept.until_s or (kept.row.name, kept.asked) != (name, asked):
                raise _bad_ticket()
            self._check_token(kept)
        except BaseException:
            kept.export.close()
            raise
        return while_allowed(kept.export, partial(self._check_token, kept))

    def _check_token(self, kept: _Ticket) -> None:
        require(caller_of(kept.token, kept.row, self._store, self._settings), *READING)

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
            kept = self._kept.pop(key, None)
        if kept is not None:
            kept.timer.cancel()
            self._leave_place(token_hash(kept.token or ""))
        return kept

    def _take_place(self, holder: bytes) -> None:
        with self._lock:
            if self._of_token.total() >= TICKETS_MAX or self._of_token[holder] >= TICKETS_OF_TOKEN_MAX:
                raise UnreachableError(
                    "too_many_tickets",
                    f"at most {TICKETS_OF_TOKEN_MAX} downloads that did not begin yet for one token and {TICKETS_MAX} "
                    f"in all; each waits {TICKET_S:g} s",
                    retry_after_s=TICKET_S,
                )
            self._of_token[holder] += 1

    def _leave_place(self, holder: bytes) -> None:
        with self._lock:
            self._of_token[holder] -= 1
            self._of_token += Counter()  # drops zeros: else every token ever seen would stay


def _bad_ticket() -> DeniedError:
    return DeniedError(
        "bad_ticket",
        f"the ticket is wrong, was used, ended ({TICKET_S:g} s), or is for another map or file; ask for another one",
    )
