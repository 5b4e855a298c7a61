"""Servers of one store, of which this is one: what an administrator has to know before robots do.

Each server of a shared store gives a sign every some seconds (`replica_notes.NotedServers`); one that has its store
alone is its site. Nothing here is secret: any token that may read some map may see it.
"""

import hashlib
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict

from cairn_map.errors import CairnError
from cairn_map.wire.access_messages import ServerInfo, SiteInfo
from cairn_server.metrics import program_version
from cairn_server.store.replica_notes import NotedServer
from cairn_server.store.store import Store

ID_BYTES = 8
ID_LABEL = b"cairn-store-id-1\0"
"""Hashed with the secret of a store to its id, so that the id tells nothing of the secret."""


class Site:
    """One server among those of its store; called from many threads."""

    def __init__(
        self,
        store: Store,
        *,
        answers: bool,
        is_folding: Callable[[], bool],
        clock_complaint: Callable[[], str | None] = lambda: None,
    ) -> None:
        """Draw an id.

        Args:
            store: of the servers.
            answers: False for a server that only folds.
            is_folding: returns True while this server folds.
            clock_complaint: returns the reason why the store's clock is not trusted; None if it is.
        """
        self._store = store
        self._clock_complaint = clock_complaint
        self._answers = answers
        self._is_folding = is_folding
        self._folded_at_s: float | None = None
        self.server_id = secrets.token_hex(ID_BYTES)
        secret = store.replicas.secret if store.replicas is not None else secrets.token_bytes(ID_BYTES)
        self.store_id = hashlib.sha256(ID_LABEL + secret).hexdigest()[: 2 * ID_BYTES]

    def folded(self) -> None:
        """Note that this server folded."""
        self._folded_at_s = time.monotonic()

    def sign(self) -> None:
        """Tell the other servers that this one is alive.

        Raises:
            CairnError: the store cannot be written now.
        """
        if self._store.replicas is not None:
            self._store.replicas.servers.put(self._own(), wall_s=time.time())

    def leave(self) -> None:
        """Tell them that it ends."""
        if self._store.replicas is not None:
            with suppress(CairnError):  # its sign ends by itself
                self._store.replicas.servers.remove(self.server_id)

    def info(self) -> SiteInfo:
        """Servers of the store, and the oldest commit that waits."""
        notes, own = self._store.replicas, self._own()
        signs = {sign.id: sign for sign in notes.servers.all()} if notes is not None else {}
        signs.setdefault(own.id, own)
        return SiteInfo(
            store="one process" if notes is None else "shared",
            store_id=self.store_id,
            server_id=self.server_id,
            servers=[ServerInfo(**asdict(signs[server])) for server in sorted(signs)],
            waiting_s=max((backlog.waited_s for backlog in self._store.health.backlogs()), default=0.0),
            clock=self._clock_complaint(),
        )

    def _own(self) -> NotedServer:
        at_s = self._folded_at_s
        return NotedServer(
            id=self.server_id,
            answers=self._answers,
            folds=self._is_folding(),
            version=program_version(),
            folded_s=None if at_s is None else time.monotonic() - at_s,
        )
