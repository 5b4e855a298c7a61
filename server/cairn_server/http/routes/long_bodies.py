"""Process that parses long bodies: parsing holds the interpreter for as long as it takes, and all requests with it.

    server ── a function and the body ──> process
           <── what the function found ──

What comes back must be made of few objects, or unpacking it here takes as long as parsing did. The process knows
nothing and keeps nothing: it can be killed at any instant. Then the server parses long bodies itself until its next
start, and says so in its log.
"""

import logging
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from fastapi.exceptions import RequestValidationError

from cairn_map.errors import CairnError
from cairn_server.processes import fork

log = logging.getLogger(__name__)

NICE = 10
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _Refused:
    """Refusal of a body."""

    error: CairnError | None
    """None: the body is not the message expected, `complaints` says why."""
    complaints: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class _Broken:
    """An unexpected error: the server tries by itself, and meets it where it is logged."""


class LongBodies:
    """The server's end of the link to the process, or no process; called from many threads."""

    def __init__(self, link: Connection | None = None, *, pid: int | None = None) -> None:
        self.pid = pid
        """Number of the process; None: there is none."""
        self._lock = threading.Lock()
        self._link = link

    def read(self, parse: Callable[[bytes], T], data: bytes) -> T:
        """Result of a function of a module for a body, computed in the process if there is one.

        Raises:
            RequestValidationError, CairnError: those of the function.
        """
        found = self._answer(parse, data)
        match found:
            case _Broken():
                return parse(data)
            case _Refused(error, complaints):
                raise error or RequestValidationError(complaints)
        result: T = found
        return result

    def close(self) -> None:
        """End the process; may be called twice."""
        with self._lock:
            if self._link is not None:
                self._link.close()
                self._link = None
            if self.pid is not None:
                os.waitpid(self.pid, 0)
                self.pid = None

    def _answer(self, parse: Callable[[bytes], Any], data: bytes) -> Any:
        with self._lock:
            if self._link is None:
                return _Broken()
            try:
                self._link.send((parse, data))
                return self._link.recv()
            except (EOFError, OSError):
                log.warning("the process that parses long bodies was killed; the server parses them itself from now on")
                self._link.close()
                self._link = None
                return _Broken()


def fork_long_bodies() -> LongBodies:
    """Fork a process that parses; only before there are threads."""
    link, pid = fork(parse_bodies)
    return LongBodies(link, pid=pid)


def parse_bodies(link: Connection) -> None:
    """Parse what the other end sends, until it is gone."""
    # The sender of a long body waits for those of short ones, on the processors, too.
    os.nice(NICE)
    with suppress(EOFError, OSError):
        while True:
            parse, data = link.recv()
            link.send(_result(parse, data))


def _result(parse: Callable[[bytes], Any], data: bytes) -> Any:
    try:
        return parse(data)
    except RequestValidationError as exc:
        return _Refused(None, tuple({"loc": each["loc"], "msg": each["msg"]} for each in exc.errors()))
    except CairnError as exc:
        return _Refused(exc)
    except Exception:  # noqa: BLE001 - the server meets it again
        return _Broken()
