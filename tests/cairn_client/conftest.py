"""A real server on a free loopback port, and hypothesis without a deadline (kernels are compiled when first called)."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import uvicorn
from hypothesis import HealthCheck, settings
from tests.fixtures.client.made import GEOMETRY, MAP

from cairn_client.http.api import MapApi
from cairn_map.wire.messages import CreateMap
from cairn_server.http.app import make_app
from cairn_server.service import Service
from cairn_server.settings import Settings
from cairn_server.store.sqlite.store import SqliteStore

settings.register_profile(
    "cairn", max_examples=50, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cairn")

WAIT_S = 20.0


class LiveServer:
    """The map server in a thread; may be stopped and started again on the same port and folder."""

    def __init__(self, folder: Path) -> None:
        self.settings = Settings(folder=folder, stable_after_s=0)
        self.port = 0
        self.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def map_url(self) -> str:
        return f"{self.url}/maps/{MAP}"

    def start(self) -> None:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(("127.0.0.1", self.port))
        listener.listen(16)
        self.port = listener.getsockname()[1]
        self.service = Service(SqliteStore(self.settings.folder), self.settings)
        config = uvicorn.Config(make_app(self.service), log_level="error", lifespan="off")
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [listener]})
        self._thread.start()
        wait_until(lambda: self._server.started)

    def stop(self) -> None:
        if self._thread.is_alive():
            self._server.should_exit = self._server.force_exit = True
            self._thread.join()
            self.service.close()

    def wait_for_fold(self) -> None:
        """Wait until nothing is pending."""
        row = self.service.store.map(MAP)

        def is_folded() -> bool:
            with self.service.store.snapshot(row) as snapshot:
                return not len(snapshot.pending())

        wait_until(is_folded)


def wait_until(is_true: Callable[[], bool]) -> None:
    """Poll until it holds, or fail."""
    deadline_s = time.monotonic() + WAIT_S
    while not is_true():
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.002)


@pytest.fixture
def until() -> Callable[[Callable[[], bool]], None]:
    return wait_until


@pytest.fixture
def server(tmp_path: Path) -> Iterator[LiveServer]:
    live = LiveServer(tmp_path / "server")
    with MapApi(live.url) as api:
        api.create_map(MAP, CreateMap(geometry=GEOMETRY))
    yield live
    live.stop()
