"""The store in PostgreSQL: the contract, on its oldest and its newest version, and what is its own."""

from collections.abc import Callable, Iterator

import pytest
from tests.fixtures.server.access_contract import AccessContract
from tests.fixtures.server.admission_contract import AdmissionContract
from tests.fixtures.server.branch_contract import BranchContract
from tests.fixtures.server.commit_contract import CommitContract
from tests.fixtures.server.crowd_contract import CrowdContract
from tests.fixtures.server.evidence_contract import EvidenceContract
from tests.fixtures.server.lease_contract import LeaseContract
from tests.fixtures.server.postgres import Database, PostgresServer, new_database
from tests.fixtures.server.replica_contract import ReplicaContract
from tests.fixtures.server.shares_contract import SharesContract
from tests.fixtures.server.store_contract import StoreContract

from cairn_server.store.postgres.store import PgStore
from cairn_server.store.store import LEASE_S, Store

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


class TestPostgresStore(
    StoreContract,
    CommitContract,
    SharesContract,
    CrowdContract,
    EvidenceContract,
    BranchContract,
    AccessContract,
    AdmissionContract,
    LeaseContract,
    ReplicaContract,
):
    """All of the contract."""

    @pytest.fixture
    def set_clock(self, kept: Database) -> Callable[[float], None]:
        """Set the database's time of day ahead of the machine's, or (negative) back."""
        return kept.set_clock

    @pytest.fixture(autouse=True)
    def clock(self, kept: Database) -> Iterator[None]:
        """The database's clock, which tests may set."""
        self._database = kept
        self._ahead_s = 0.0
        yield
        kept.set_clock(0.0)

    def expire(self, store: Store) -> None:
        """Let the time of all claims pass."""
        self.go_on(store, 2 * LEASE_S)

    def go_on(self, store: Store, seconds: float) -> None:
        """Let time pass for the database."""
        self._ahead_s += seconds
        self._database.set_clock(self._ahead_s)
