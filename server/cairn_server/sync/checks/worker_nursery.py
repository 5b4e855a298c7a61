"""The process that workers are forked from: it has loaded all kernels, so a new worker is ready in milliseconds.

    server ── control socket ──> nursery (one thread, kernels warm) ── fork ──> worker, worker, ...
       └───────────────────── a socket for each worker ──────────────────────────┘

    $ python -m cairn_server.sync.checks.worker_nursery FD MEMORY_BYTES      # only the server starts it

A worker gets commits, each as a length (u64) and its bytes, and answers each with a length and JSON. It holds nothing
of the server's: no store, no token, no listening socket. It dies with the nursery, which dies with the server: the
kernel tells both (a closed socket, PR_SET_PDEATHSIG), even if the server was killed. Nothing is ever forked from a
process with threads.
"""

import json
import os
import resource
import signal
import socket
import sys
from pathlib import Path

from cairn_map.commits.commit_reading import commit_reader
from cairn_map.errors import BadInputError, CairnError, DamagedDataError
from cairn_map.warm_up import CHECK_PARTS, SERVER_PARTS
from cairn_server.processes import LENGTH, die_with_parent, received, send
from cairn_server.sync.checks.checking import Checked, check_commit

FAMILIES: dict[str, type[CairnError]] = {family.__name__: family for family in (BadInputError, DamagedDataError)}
RETIRED_SHARE = 4
"""Divisor of the memory limit: a worker that ever held more than this part is replaced, so that memory goes back."""


def main(control_fd: int, memory_bytes: int) -> None:
    """Fork a worker for each socket that comes, until the server is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel buries workers
    for part in CHECK_PARTS:
        SERVER_PARTS[part]()
    with socket.socket(fileno=control_fd) as control:
        while True:
            message, fds, _, _ = socket.recv_fds(control, 1, 1)
            if not message:
                return
            nursery = os.getpid()
            if os.fork() == 0:
                control.close()
                _be_worker(fds[0], memory_bytes, nursery)
            os.close(fds[0])


def _be_worker(fd: int, memory_bytes: int, nursery: int) -> None:
    try:
        die_with_parent(nursery)
        limit, start_bytes = _address_space_bytes() + memory_bytes, _peak_bytes()
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with socket.socket(fileno=fd) as jobs:
            jobs.sendall(LENGTH.pack(os.getpid()))
            while (data := received(jobs)) is not None:
                answer = answer_to(data)
                retires = "memory" in answer or _peak_bytes() - start_bytes > memory_bytes // RETIRED_SHARE
                send(jobs, json.dumps(answer | {"retires": retires}).encode())
                if retires:
                    return
    except OSError:
        pass  # the server is gone, or wants this worker no more
    finally:
        os._exit(0)


def answer_to(data: bytes) -> dict[str, object]:
    """Result of a check, for JSON."""
    try:
        checked = check_commit(commit_reader(data))
    except CairnError as exc:
        return {"family": type(exc).__name__, "kind": exc.kind, "message": exc.message}
    except MemoryError:
        return {"memory": True}
    return {"sha": checked.sha.hex(), "tops": list(checked.tops.items()), "bricks": checked.bricks}


def checked_from(answer: dict[str, object]) -> Checked:
    """Result that `answer_to` described; lack of memory excepted.

    Raises:
        BadInputError, DamagedDataError: what it found wrong.
    """
    if "family" in answer:
        raise FAMILIES[str(answer["family"])](str(answer["kind"]), str(answer["message"]))
    tops, bricks = answer["tops"], answer["bricks"]
    assert isinstance(tops, list)  # noqa: S101 - `answer_to` wrote it
    assert isinstance(bricks, int)  # noqa: S101 - and this
    return Checked(bytes.fromhex(str(answer["sha"])), {region: tuple(top) for region, top in tops}, bricks)


def _address_space_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
