"""Two servers over one store in memory."""

from collections.abc import Iterator

import pytest
from tests.fixtures.server.replicas import Servers, SharedMemoryStore
from tests.fixtures.server.two_servers_contract import Stores, TwoServersContract, administered


@pytest.fixture(scope="module")
def stores() -> Stores:
    """One store, which both have."""
    return lambda: (SharedMemoryStore(),) * 2


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory, stores: Stores) -> Iterator[Servers]:
    """Two servers for all tests that leave nothing behind."""
    with administered(tmp_path_factory.mktemp("two"), stores()) as found:
        yield found


class TestTwoServers(TwoServersContract):
    """All of the contract."""
