"""Two servers over one database in PostgreSQL."""

from collections.abc import Iterator

import pytest
from tests.fixtures.server.postgres import PostgresServer, new_database
from tests.fixtures.server.replicas import Servers
from tests.fixtures.server.two_servers_contract import Stores, TwoServersContract, administered

from cairn_server.store import known_tokens
from cairn_server.store.postgres.store import PgStore
from cairn_server.store.store import Store

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.fixture(scope="module")
def stores(postgres: PostgresServer) -> Stores:
    """Two stores on a new database."""

    def opened() -> tuple[Store, Store]:
        url = new_database(postgres).url
        return PgStore(url), PgStore(url)

    return opened


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory, stores: Stores) -> Iterator[Servers]:
    """Two servers for all tests that leave nothing behind."""
    with administered(tmp_path_factory.mktemp("two"), stores()) as found:
        yield found


class TestTwoServersOnPostgres(TwoServersContract):
    """All of the contract."""

    @pytest.fixture(autouse=True)
    def a_second_later(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Servers hear within a second of tokens that ended elsewhere: here at once."""
        monkeypatch.setattr(known_tokens, "KNOWN_S", 0.0)
