"""A real server on a free loopback port, and hypothesis without a deadline (kernels are compiled when first called)."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from tests.fixtures.client.live_server import LiveServer, wait_until
from tests.fixtures.client.made import GEOMETRY, MAP

from cairn_client.http.api import MapApi
from cairn_map.wire.messages import CreateMap

settings.register_profile(
    "cairn", max_examples=50, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cairn")


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
