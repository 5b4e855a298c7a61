"""Quotas of a robot's pushes; commits that are refused, known or an administrator's cost nothing."""

from contextlib import nullcontext
from pathlib import Path

import pytest
from tests.fixtures.map.costly import dust
from tests.fixtures.map.made import SMALL, random_evidence
from tests.fixtures.server import signatures
from tests.fixtures.server.access import ADMIN, bearer, robot_token
from tests.fixtures.server.answers import kind_of
from tests.fixtures.server.pushes import KEYS, WREN, pushed
from tests.fixtures.server.quotas import MOLE_CALLER, SIZE, Clock, assert_waits, guarded, metered, spend

from cairn_client.http.api import MapApi
from cairn_map.commits.commit import Commit
from cairn_map.errors import BadInputError, UnreachableError
from cairn_map.evidence.grid import BRICK_DEPTH, Geometry, cell_key, level_geometry
from cairn_map.wire.access_messages import CreateToken
from cairn_server.access import quotas
from cairn_server.access.auth import ADMIN_FILE, UPSTREAM, Caller, Role
from cairn_server.access.quotas import DAY_S
from cairn_server.access.tokens import create_token
from cairn_server.operations.serve import main


def far(n: int, distance: int) -> Commit:
    cells = {cell_key((distance, 0, 0)): random_evidence(n, SMALL, voxels=3, air=1)}
    return pushed(n, n, cells=cells)


def test_commits_a_minute_come_back_by_and_by(tmp_path: Path) -> None:
    clock = Clock()
    with metered(tmp_path, clock, commits_per_minute=6) as (meter, row):
        assert [spend(meter, row) for _ in range(7)] == [None] * 6 + [10]
        clock.now_s += 9
        assert spend(meter, row) == 1
        clock.now_s += 1
        assert [spend(meter, row), spend(meter, row)] == [None, 10]
        clock.now_s += 3600
        assert [spend(meter, row) for _ in range(7)] == [None] * 6 + [10]


@pytest.mark.parametrize(
    ("quota", "what"), [("bytes_per_day", "size_bytes"), ("cells_per_day", "cells"), ("bricks_per_day", "bricks")]
)
def test_a_days_quota_is_whole_again_at_midnight(tmp_path: Path, quota: str, what: str) -> None:
    clock = Clock()
    with metered(tmp_path, clock, **{quota: 100}) as (meter, row):
        assert spend(meter, row, **{what: 60}) is None
        assert spend(meter, row, **{what: 41}) == DAY_S - 3600
        assert spend(meter, row, **{what: 40}) is None
        clock.now_s += DAY_S - 3601
        assert spend(meter, row, **{what: 1}) == 1
        clock.now_s += 1
        assert spend(meter, row, **{what: 100}) is None


def test_what_was_not_accepted_is_given_back(tmp_path: Path) -> None:
    with metered(tmp_path, Clock(), commits_per_minute=1, bytes_per_day=10, cells_per_day=10) as (meter, row):
        for _ in range(20):
            assert spend(meter, row, size_bytes=10, cells=10, keep=False) is None
        with pytest.raises(ZeroDivisionError), meter.spending(row, MOLE_CALLER, size_bytes=10, cells=KEYS):
            raise ZeroDivisionError
        assert spend(meter, row, size_bytes=10, cells=10) is None
        assert spend(meter, row, size_bytes=1) is not None


def test_dust_is_refused_until_midnight_and_what_its_bytes_pay_for_never(tmp_path: Path) -> None:
    wide = Geometry(voxel_edge_um=50_000, depth=7, channels=())
    dusty = [pushed(n, n, geometry=wide, cells={KEYS[n]: dust(wide)}, scans=1) for n in range(2)]
    unpaid = 8 ** (wide.depth - BRICK_DEPTH) - len(dusty[0].data)
    assert unpaid > 8 * len(dusty[0].data)
    for start in range(2):
        with guarded(tmp_path, bricks_per_day=unpaid * 3 // 2) as live:
            if not start:
                row = live.new_map(wide)
            mole = bearer(robot_token(live, row, "mole"))
            if not start:
                assert live.push(row, dusty[0], headers=mole).status_code == 201
            refused = live.push(row, dusty[1], headers=mole)
            assert_waits(refused, 1, DAY_S)
            assert "quotas.bricks_per_day" in refused.json()["detail"]
            for n in range(3):
                seen = pushed(10 * start + n + 2, n, geometry=wide)
                assert live.push(row, seen, headers=mole).status_code == 201


def test_parallel_pushes_share_one_quota(tmp_path: Path) -> None:
    with (
        metered(tmp_path, Clock(), bytes_per_day=10) as (meter, row),
        meter.spending(row, MOLE_CALLER, size_bytes=6, cells=KEYS),
    ):
        assert spend(meter, row, size_bytes=5) is not None
        assert spend(meter, row, size_bytes=4) is None
        with meter.spending(row, Caller(Role.ROBOT, "wren"), size_bytes=6, cells=KEYS):
            pass


def test_quotas_are_answered_with_the_time_to_wait_and_the_client_hears_it(tmp_path: Path) -> None:
    with guarded(tmp_path, commits_per_minute=2) as live:
        row = live.new_map()
        mole = robot_token(live, row, "mole")
        for n in range(2):
            assert live.push(row, pushed(n, n), headers=bearer(mole)).status_code == 201
        assert_waits(live.push(row, pushed(2, 2), headers=bearer(mole)), 20, 30)
        with MapApi(str(live.http.base_url), token=mole) as api, pytest.raises(UnreachableError) as refused:
            api.push(row.name, pushed(2, 2))
        assert refused.value.kind == "quota"
        assert refused.value.retry_after_s and 20 <= refused.value.retry_after_s <= 30
        # Others are not its fault, and an administrator has none.
        assert live.push(row, pushed(0, 0, WREN), headers=bearer(robot_token(live, row, "wren"))).status_code == 201
        assert live.push(row, pushed(2, 2), headers=bearer(ADMIN)).status_code == 201
        other = live.new_map()
        assert live.push(other, pushed(0, 0), headers=bearer(robot_token(live, other, "mole"))).status_code == 201


def test_what_was_refused_or_known_costs_nothing(tmp_path: Path) -> None:
    with guarded(tmp_path, commits_per_minute=2) as live:
        row = live.new_map()
        mole = bearer(robot_token(live, row, "mole"))
        assert live.push(row, pushed(0, 0), headers=mole).status_code == 201
        for _ in range(3):
            assert live.push(row, pushed(0, 0), headers=mole).status_code == 200
            assert live.push(row, pushed(0, 1), headers=mole).status_code == 409
            assert kind_of(live.push(row, pushed(1, 1, scans=0), headers=mole)) == "too_much_evidence"
        assert live.push(row, pushed(1, 1), headers=mole).status_code == 201


def test_a_quota_is_looked_at_before_evidence_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with guarded(tmp_path, cells_per_commit=1) as live:
        row = live.new_map()
        monkeypatch.setattr(live.service.sync.pushes.checks, "check", lambda commit: pytest.fail("decoded"))
        answer = live.push(row, pushed(0, 0), headers=bearer(robot_token(live, row, "mole")))
        assert (answer.status_code, kind_of(answer)) == (400, "beyond_quota")
        assert "Retry-After" not in answer.headers


def test_a_days_quota_survives_a_new_start(tmp_path: Path) -> None:
    for start in range(2):
        with guarded(tmp_path, bytes_per_day=SIZE * 3 // 2) as live:
            if not start:
                row = live.new_map()
            mole = bearer(robot_token(live, row, "mole"))
            if not start:
                assert live.push(row, pushed(0, 0), headers=mole).status_code == 201
            assert_waits(live.push(row, pushed(1, 0), headers=mole), 1, DAY_S)


def test_a_relay_has_quotas_of_its_own_by_its_token_after_a_new_start_too(tmp_path: Path) -> None:
    commits = [pushed(n, n, author) for n, author in enumerate((signatures.MOLE, signatures.WREN, signatures.MOLE))]
    for start in range(2):
        with guarded(tmp_path, bytes_per_day=SIZE * 3 // 2) as live:
            if not start:
                row = live.new_map()
                names = ("field", "other")
                made = [create_token(live.service.store, n, CreateToken(role="relay"), by=ADMIN_FILE) for n in names]
                mole = bearer(robot_token(live, row, "mole"))
                live.service.store.keys.admit(row, signatures.MOLE, by="operator")
            field, other = (bearer(token.token) for token in made)
            signed = [signatures.signed(row, commit) for commit in commits]
            if not start:
                assert live.push(row, commits[0], headers=signed[0] | field).status_code == 201
                assert live.push(row, pushed(0, 0), headers=mole).status_code == 201, "nothing of the robot's"
            assert_waits(live.push(row, commits[1], headers=signed[1] | field), 1, DAY_S)
    with guarded(tmp_path, bytes_per_day=SIZE * 3 // 2) as live:
        assert live.push(row, commits[2], headers=signed[2] | other).status_code == 201


def test_what_a_relay_brings_is_not_larger_or_farther_than_what_a_robot_may(tmp_path: Path) -> None:
    with guarded(tmp_path, cells_per_commit=1, map_extent_m=10 * SMALL.cell_edge_m) as live:
        row = live.new_map()
        relay = bearer(create_token(live.service.store, "field", CreateToken(role="relay"), by=ADMIN_FILE).token)
        near = {cell_key((0, 0, 0)): random_evidence(1, SMALL, voxels=3, air=1)}
        far_away = {cell_key((900, 0, 0)): random_evidence(1, SMALL, voxels=3, air=1)}
        answers = []
        for n, cells in enumerate((near, far_away, None)):
            commit = pushed(n, n, signatures.MOLE, cells=cells)
            signed = signatures.signed(row, commit)
            answers.append(live.push(row, commit, headers=signed | relay))
            with pytest.raises(BadInputError) if n else nullcontext():
                live.service.sync.pushes.keep(
                    row, UPSTREAM, str(commit.id), commit.data, signatures=signed["Cairn-Signature"]
                )
        assert answers[0].status_code == 201
        assert [kind_of(answer) for answer in answers[1:]] == ["beyond_quota"] * 2


def test_a_server_s_own_upstream_may_bring_all_of_an_old_map_at_once(tmp_path: Path) -> None:
    with metered(tmp_path, Clock(), commits_per_minute=1, bytes_per_day=1, bricks_per_day=1) as (meter, row):
        for keep in (True, False, True):
            with meter.spending(row, UPSTREAM, size_bytes=9, cells=KEYS, via=UPSTREAM.name) as spending:
                spending.charge_bricks(100)
                if keep:
                    spending.keep()


def test_a_robot_s_cells_span_the_map_s_extent_and_a_retract_makes_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quotas, "BOX_EVERY_S", 0.0)
    monkeypatch.setattr(quotas, "BOX_PAUSE_FACTOR", 0.0)
    edge_m = SMALL.cell_edge_m
    with guarded(tmp_path, map_extent_m=10 * edge_m) as live:
        row = live.new_map()
        mole = bearer(robot_token(live, row, "mole"))
        assert live.push(row, far(0, 900), headers=mole).status_code == 201
        assert live.push(row, far(1, 891), headers=mole).status_code == 201
        wren = bearer(robot_token(live, row, "wren"))
        near = {cell_key((0, 0, 0)): random_evidence(1, SMALL, voxels=3, air=1)}
        assert live.push(row, pushed(0, 0, WREN, cells=near), headers=wren).status_code == 201, "another's is its own"
        for distance in (890, 901, 0):
            answer = live.push(row, far(2, distance), headers=mole)
            assert (answer.status_code, kind_of(answer)) == (400, "beyond_quota"), distance
        live.folded(row)
        body = {"commits": [str(far(0, 900).id), str(far(1, 891).id)]}
        assert live.http.post(f"/maps/{row.name}/retracts", json=body, headers=bearer(ADMIN)).status_code == 201
        live.folded(row)
        assert live.push(row, far(2, 0), headers=mole).status_code == 201


def test_the_extent_of_a_level_counts_its_cells_height_along_z(tmp_path: Path) -> None:
    level = level_geometry()
    edge_m, _, height_m = level.cell_edges_m
    assert edge_m == 4 * height_m
    with metered(tmp_path, Clock(), geometry=level, map_extent_m=8 * height_m) as (meter, row):
        for corner, is_within in (((1, 0, 7), True), ((0, 0, 8), False), ((2, 0, 0), False)):
            cells = [cell_key((0, 0, 0)), cell_key(corner)]
            expected = nullcontext() if is_within else pytest.raises(BadInputError, match="would span")
            with expected, meter.spending(row, MOLE_CALLER, size_bytes=1, cells=cells):
                pass


def test_the_box_of_a_robot_is_not_read_anew_for_every_refusal(tmp_path: Path) -> None:
    clock = Clock()
    with metered(tmp_path, clock, map_extent_m=SMALL.cell_edge_m * 3) as (meter, row):
        assert spend(meter, row, cells=3) is None
        reads = []
        regions = meter._store.shares.regions
        meter._store.shares.regions = lambda row, robot: (reads.append(row), regions(row, robot))[1]  # type: ignore[method-assign]
        for _ in range(50):
            with pytest.raises(BadInputError):
                spend(meter, row, cells=4)
        assert len(reads) == 0
        clock.now_s += 10
        with pytest.raises(BadInputError):
            spend(meter, row, cells=4)
        assert len(reads) == 1


@pytest.mark.parametrize("quota", ["commits_per_minute", "bytes_per_day", "map_extent_m"])
def test_a_quota_below_nothing_is_refused_and_names_its_setting(quota: str, tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text(f"quotas.{quota} = -1\n")
    with pytest.raises(BadInputError, match=f"settings.toml: quotas.{quota}"):
        main(["--data", str(tmp_path / "data"), "--port", "0", "--settings", str(tmp_path / "settings.toml")])
