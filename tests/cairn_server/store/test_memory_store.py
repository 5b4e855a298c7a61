"""The store in memory: the contract, and what is its own."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from tests.fixtures.map.made import SMALL
from tests.fixtures.server.access import ADMIN, ENROLLER, bearer, robot_token
from tests.fixtures.server.access_contract import AccessContract
from tests.fixtures.server.admission_contract import AdmissionContract
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.attachment_contract import AttachmentContract
from tests.fixtures.server.branch_contract import BranchContract
from tests.fixtures.server.commit_contract import CommitContract
from tests.fixtures.server.crowd_contract import CrowdContract
from tests.fixtures.server.deletion_contract import DeletionContract
from tests.fixtures.server.epoch_contract import EpochContract
from tests.fixtures.server.evidence_contract import EvidenceContract
from tests.fixtures.server.fetching import fetch
from tests.fixtures.server.layer_contract import LayerContract
from tests.fixtures.server.live import Live
from tests.fixtures.server.mark_contract import MarkContract
from tests.fixtures.server.pushes import MOLE, WREN, pushed, read, sum_of
from tests.fixtures.server.replica_contract import ReplicaContract
from tests.fixtures.server.shares_contract import SharesContract
from tests.fixtures.server.store_contract import StoreContract
from tests.memory_store import tokens as memory_tokens
from tests.memory_store.replicas import MemoryReplicaNotes
from tests.memory_store.store import MemoryStore
from tests.naive.asker import NaiveAsker

from cairn_client.http.api import MapApi
from cairn_map.errors import UnreachableError
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.wire.access_messages import CreateToken
from cairn_server.store.store import Store
from cairn_server.store.store_age import Clocks
from cairn_server.store.store_rows import MapRow


@pytest.fixture(scope="module")
def store() -> Iterator[MemoryStore]:
    """The contract's store."""
    made = MemoryStore()
    yield made
    made.close()


class TestMemoryStore(
    StoreContract,
    CommitContract,
    SharesContract,
    CrowdContract,
    EvidenceContract,
    EpochContract,
    MarkContract,
    LayerContract,
    AttachmentContract,
    BranchContract,
    AccessContract,
    AdmissionContract,
    DeletionContract,
):
    """All of the contract."""

    clears = False

    def rows_of(self, store: Store, row: MapRow) -> dict[str, int]:
        """Nothing: there are no rows."""
        return {}


class Passing:
    """A steady clock that goes on when a test says so."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class TestMemoryReplicaNotes(ReplicaContract):
    """Of a store in memory."""

    clock = Passing()

    @pytest.fixture
    def store(self) -> MemoryStore:
        return MemoryStore(make_notes=lambda maps: MemoryReplicaNotes(maps, Clocks(steady_s=self.clock)))

    def go_on(self, store: Store, seconds: float) -> None:
        self.clock.now_s += seconds


def test_a_server_works_on_it_as_on_any_other(tmp_path: Path) -> None:
    with Live(tmp_path, store=MemoryStore()) as live:
        row, asker = live.new_map(), NaiveAsker(MOLE, asks_for=("delta", "state", "full"))
        register = {"robot": "mole", "incarnation": MOLE.incarnation}
        assert live.http.post(f"/maps/{row.name}/branches", json=register).status_code == 201
        commits = [pushed(n, n, WREN) for n in range(4)]
        for commit in commits:
            assert live.push(row, commit).status_code == 201
            fetch(live, row, asker)
        assert asker.map() == read(live.cells(row)) == sum_of(commits)
        assert live.push(row, commits[0]).status_code == 200
        assert live.retract(row, commits[1]).status_code == 201
        fetch(live, row, asker)
        kept = [commit for commit in commits if commit != commits[1]]
        assert asker.map() == read(live.cells(row)) == sum_of(kept)
        assert live.service.store.forget_evidence(row, before_s=float("inf"), limit=9) == 4
        assert kind_of(live.retract(row, commits[2])) == "evidence_gone"
        live.push(row, pushed(9, 2, WREN))
        fetch(live, row, asker)
        assert asker.map() == read(live.cells(row)) == sum_of([*kept, pushed(9, 2, WREN)])
        fetch(live, row, asker)
        [branch] = live.http.get(f"/maps/{row.name}/branches").json()
        assert (branch["branch"], branch["behind"], branch["incarnation"]) == ("mole", 0, MOLE.incarnation)
        assert live.http.get("/readyz").status_code == live.http.get("/metrics").status_code == 200


def test_a_guarded_server_keeps_its_tokens_and_its_audit_log_there(tmp_path: Path) -> None:
    with Live(tmp_path, store=MemoryStore(), admin_token=ADMIN, enrolment_token=ENROLLER) as live:
        row = live.new_map()
        robot = bearer(robot_token(live, row, "mole"))
        assert live.push(row, pushed(0, 0), headers=robot).status_code == 201
        assert kind_of(live.push(row, pushed(0, 0, WREN), headers=robot)) == "not_allowed"
        assert live.http.delete(f"/maps/{row.name}/branches/mole", headers=bearer(ADMIN)).is_success
        assert kind_of(live.push(row, pushed(1, 0), headers=robot)) == "bad_token"
        with MapApi(str(live.http.base_url), token=ADMIN) as admin:
            secret = admin.create_token("eye", CreateToken(role="reader", map=row.name)).token
            assert live.http.get(f"/maps/{row.name}/log", headers=bearer(secret)).is_success
            admin.revoke_token("eye")
        assert kind_of(live.http.get(f"/maps/{row.name}/log", headers=bearer(secret))) == "bad_token"
        lines = live.service.store.audit_log.page(after=0, limit=99)
        assert len(lines) > 1 and all(line.is_next_after(before) for before, line in pairwise(lines))


def test_the_audit_log_keeps_its_newest_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_tokens, "AUDIT_ROWS_MAX", 3)
    store = MemoryStore()
    for n in range(9):
        store.audit("test", str(n))
    assert [line.detail for line in store.audit_log.page(after=0, limit=99)] == ["6", "7", "8"]


def test_a_closed_store_says_so_and_notes_are_dropped_silently() -> None:
    store = MemoryStore()
    row, _ = store.create_map("lab", SMALL, SensorModel())
    store.close()
    store.audit("late", "nobody hears it")
    store.seen(row, "mole", None)
    store.notes.put_status(row, "mole", "{}")
    store.tokens.used("eye")
    with pytest.raises(UnreachableError):
        store.maps()
