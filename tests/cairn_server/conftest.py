"""Hypothesis as in `tests/cairn_map`, and a server that trusts this machine."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from tests.fixtures.server.live import Live

settings.register_profile(
    "cairn", max_examples=50, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cairn")


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A server on loopback without tokens, for the tests of one module."""
    folder: Path = tmp_path_factory.mktemp("open")
    with Live(folder) as server:
        yield server
