"""The connections of an HTTP client, so that another thread can cut what is under way on them.

A thread that sends or receives waits up to half a minute for the other side. Closing its socket would not wake it;
shutting it down does, at once.
"""

import contextlib
import socket
import threading
import weakref
from collections.abc import Mapping
from typing import Any

from cairn_map.errors import UnreachableError

OPENED = ("connection.connect_tcp.complete", "connection.start_tls.complete")


class OpenSockets:
    """Sockets that a client opened; `watch` is to be called with each request (httpx's event hook)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sockets: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        self._is_cut = False

    def watch(self, request: Any) -> None:
        """Note the connection that a request makes, if it makes one.

        Raises:
            UnreachableError: kind `interrupted`: nothing is to be sent any more.
        """
        self._check()
        request.extensions = {**request.extensions, "trace": self._trace}

    def cut(self) -> None:
        """End all that is under way, and let nothing begin until `mend`; by any thread."""
        with self._lock:
            self._is_cut = True
            for found in list(self._sockets):
                with contextlib.suppress(OSError):
                    # The plain socket's: that of TLS would say goodbye first.
                    socket.socket.shutdown(found, socket.SHUT_RDWR)

    def mend(self) -> None:
        """Requests may be sent again; each makes a connection of its own if it must."""
        self._is_cut = False

    def _trace(self, name: str, info: Mapping[str, Any]) -> None:
        if name in OPENED:
            found = info["return_value"].get_extra_info("socket")
            with self._lock:
                if isinstance(found, socket.socket):
                    self._sockets.add(found)
            self._check()

    def _check(self) -> None:
        if self._is_cut:
            raise UnreachableError("interrupted", "the robot is being closed")
