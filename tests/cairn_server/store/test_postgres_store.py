"""The store in PostgreSQL: the contract, on its oldest and its newest version, and what is its own."""

from collections.abc import Iterator

import pytest
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.postgres_contract import PostgresContract

from cairn_server.store.postgres.store import PgStore

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.fixture(scope="module")
def kept(postgres: PostgresServer) -> Database:
    """The database of the contract's store."""
    return new_database(postgres)


@pytest.fixture(scope="module")
def store(kept: Database) -> Iterator[PgStore]:
    """The contract's store."""
    made = PgStore(kept.url)
    yield made
    made.close()


class TestPostgresStore(PostgresContract):
    """All of the contract."""
