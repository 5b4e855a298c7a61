"""The store in memory: the contract, and what is its own."""

from collections.abc import Iterator

import pytest
from tests.cairn_map.made import SMALL
from tests.cairn_server.access_contract import AccessContract
from tests.cairn_server.branch_contract import BranchContract
from tests.cairn_server.commit_contract import CommitContract
from tests.cairn_server.evidence_contract import EvidenceContract
from tests.cairn_server.store_contract import StoreContract

from cairn_map.errors import UnreachableError
from cairn_map.sensor_model import SensorModel
from cairn_server.memory_store import MemoryStore


@pytest.fixture(scope="module")
def store() -> Iterator[MemoryStore]:
    """The contract's store."""
    made = MemoryStore()
    yield made
    made.close()


class TestMemoryStore(StoreContract, CommitContract, EvidenceContract, BranchContract, AccessContract):
    """All of the contract."""


def test_a_closed_store_says_so_and_notes_are_dropped_silently() -> None:
    store = MemoryStore()
    row, _ = store.create_map("lab", SMALL, SensorModel())
    store.close()
    store.audit("late", "nobody hears it")
    store.seen(row, "mole", None)
    with pytest.raises(UnreachableError):
        store.maps()
