"""The store whose bytes are in an object store as soon as they are at rest: the contract, and what is its own."""

from collections.abc import Iterator

import pytest
from tests.fixtures.server.object_store import ObjectServer
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.postgres_contract import PostgresContract
from tests.fixtures.server.settled_store import SettledStore

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.fixture(scope="module")
def kept(newest_postgres: PostgresServer) -> Database:
    """The database of the contract's store."""
    return new_database(newest_postgres)


@pytest.fixture(scope="module")
def store(kept: Database, object_server: ObjectServer) -> Iterator[SettledStore]:
    """The contract's store, which settles after each fold."""
    place = object_server.new_place()
    made = SettledStore(kept.url, object_server.bucket(place), place=place)
    yield made
    made.close()


class TestColdStore(PostgresContract):
    """All of the contract, read from the object store."""
