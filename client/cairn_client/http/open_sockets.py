"""Sockets of a client, which another thread may cut: a robot that is being closed, or a server that went silent."""

import contextlib
import socket
import threading
import weakref
from collections.abc import Mapping
from typing import Any

from cairn_client.http.url_scheme import certificate_end_s
from cairn_map.errors import UnreachableError

OPENED = ("connection.connect_tcp.complete", "connection.start_tls.complete")
"""Events of httpcore that hand out a new connection's stream."""


class OpenSockets:
    """Sockets that a client opened; `watch` is to be called with each request (httpx's event hook)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sockets: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        self.is_cut = False
        """True while nothing is to be sent."""
        self.certificate_end_s: float | None = None
        """End of the certificate that the server showed last, UTC seconds since 1970; None: it showed none."""

    def watch(self, request: Any) -> None:
        """Note the connection that a request makes, if it makes one.

        Raises:
            UnreachableError: kind `interrupted`: nothing is to be sent any more.
        """
        self._check()
        request.extensions = {**request.extensions, "trace": self._trace}

    def cut(self) -> None:
        """End all that is under way, and let nothing begin until `mend`; by any thread."""
        self.is_cut = True
        self.break_off()

    def break_off(self) -> None:
        """End all that is under way; by any thread."""
        with self._lock:
            for found in list(self._sockets):
                with contextlib.suppress(OSError):
                    # The plain socket's: that of TLS would say goodbye first.
                    socket.socket.shutdown(found, socket.SHUT_RDWR)

    def mend(self) -> None:
        """Requests may be sent again; each makes a connection of its own if it must."""
        self.is_cut = False

    def _trace(self, name: str, info: Mapping[str, Any]) -> None:
        if name in OPENED:
            found = info["return_value"].get_extra_info("socket")
            self.certificate_end_s = certificate_end_s(found)
            with self._lock:
                if isinstance(found, socket.socket):
                    self._sockets.add(found)
            self._check()

    def _check(self) -> None:
        if self.is_cut:
            raise UnreachableError("interrupted", "the robot is being closed")
