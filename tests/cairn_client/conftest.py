"""A real server on a free loopback port."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.fixtures.client.live_server import LiveServer, wait_until
from tests.fixtures.client.made import GEOMETRY, MAP

from cairn_client.http.api import MapApi
from cairn_map.wire.messages import CreateMap


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
