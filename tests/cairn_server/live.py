"""Real servers for tests: in a thread, or as a process that can be killed."""

import itertools
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
import uvicorn
from tests.cairn_map.made import SMALL

from cairn_map.commits.commit import Commit
from cairn_map.evidence.grid import Geometry
from cairn_map.evidence.sensor_model import SensorModel
from cairn_map.wire.messages import CreateMap, Retract
from cairn_server.http.app import make_app
from cairn_server.operations.serve import config_of, listen
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite.store import SqliteStore
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow

DEADLINE_S = 60.0


def free_port(host: str) -> int:
    """A port of this machine at which nobody listens."""
    with socket.socket() as free:
        free.bind((host, 0))
        return int(free.getsockname()[1])


def until(condition: Callable[[], bool], what: str) -> None:
    """Look again until it is so."""
    end_s = time.monotonic() + DEADLINE_S
    pause = threading.Event()
    while not condition():
        assert time.monotonic() < end_s, f"not in {DEADLINE_S} s: {what}"
        pause.wait(0.002)


class Live:
    """A server in this process, reached through its socket."""

    def __init__(self, folder: Path, *, store: Store | None = None, **settings: Any) -> None:
        self.service = Service(store or SqliteStore(folder), Settings(folder=folder, **settings))
        self.app = make_app(self.service)
        listener = listen("127.0.0.1", 0)
        self.port: int = listener.getsockname()[1]
        self._server = uvicorn.Server(config_of(self.app, self.service.settings, log_level="critical"))
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [listener]})
        self._thread.start()
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=DEADLINE_S)
        self._names = (f"map{n}" for n in itertools.count())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.http.close()
        self.service.live.close()
        self._server.should_exit = True
        self._thread.join()
        self.service.close()

    def new_map(self, geometry: Geometry = SMALL, sensor_model: SensorModel | None = None) -> MapRow:
        """An empty map of its own name."""
        name = next(self._names)
        self.service.create_map(name, CreateMap(geometry=geometry, sensor_model=sensor_model or SensorModel()))
        return self.service.store.map(name)

    def push(self, row: MapRow, commit: Commit, **options: Any) -> httpx.Response:
        """Push through HTTP."""
        return self.http.put(f"/maps/{row.name}/commits/{commit.id}", content=commit.data, **options)

    def retract(self, row: MapRow, *commits: Commit, **fields: Any) -> httpx.Response:
        """Retract through HTTP."""
        request = Retract(commits=[str(commit.id) for commit in commits], **fields)
        return self.http.post(f"/maps/{row.name}/retracts", json=request.model_dump())

    def ask(self, method: str, url: str, **options: Any) -> httpx.Response:
        """An answer; of a stream without end only its head."""
        return self.answer_to(self.http.build_request(method, url, **options))

    def answer_to(self, request: httpx.Request) -> httpx.Response:
        """The same for a request as it is."""
        answer = self.http.send(request, stream=True)
        if not answer.headers.get("Content-Type", "").startswith("text/event-stream"):
            answer.read()
        answer.close()
        return answer

    def folded(self, row: MapRow) -> None:
        """Return when nothing is pending."""
        until(lambda: self.pending(row) == 0, "everything is folded")

    def pending(self, row: MapRow) -> int:
        """Commits that are not folded yet."""
        with self.service.store.snapshot(row) as snapshot:
            return len(snapshot.pending())

    def cells(self, row: MapRow) -> dict[int, bytes]:
        """All cells' bytes, emptied ones left out, when everything is folded."""
        self.folded(row)
        with self.service.store.snapshot(row) as snapshot:
            found = [snapshot.cell(cell.key) for cell in snapshot.cells() if cell.voxels]
        return {cell.key: cell.body for cell in found if cell}


class Process:
    """`cairn serve` as a process of its own; `url` is None if it did not start."""

    def __init__(self, folder: Path, *arguments: str, under: tuple[str, ...] = ()) -> None:
        """Start it, perhaps under another program."""
        # Not into a pipe: nobody reads it meanwhile, and a server that complains much would wait for ever.
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - `end` closes it
        self._process = subprocess.Popen(
            [
                *under,
                sys.executable,
                "-m",
                "cairn_client.main",
                "serve",
                "--data",
                str(folder),
                "--port",
                "0",
                *arguments,
            ],
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env={name: value for name, value in os.environ.items() if not name.startswith("CAIRN_")},
        )
        assert self._process.stdout is not None
        found = re.search(r"https?://127\.0\.0\.1:\d+", self._process.stdout.readline())
        self.url = found[0] if found else None

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def send(self, number: int) -> None:
        """A signal."""
        self._process.send_signal(number)

    def peak_mb(self) -> int:
        """Its largest resident memory so far."""
        found = re.search(r"VmHWM:\s*(\d+) kB", Path(f"/proc/{self._process.pid}/status").read_text())
        assert found
        return int(found[1]) >> 10

    def said(self) -> str:
        """What it complained of so far."""
        self._errors.flush()
        self._errors.seek(0)
        return self._errors.read()

    def end(self) -> tuple[int, str]:
        """Exit code and what it complained of, once it ended."""
        self._process.communicate(timeout=DEADLINE_S)
        with self._errors:
            self._errors.seek(0)
            return self._process.returncode, self._errors.read()
