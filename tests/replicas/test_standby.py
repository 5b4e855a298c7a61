"""Servers whose URL names a standby, too: none of them works on it before it is the primary."""

from contextlib import closing
from pathlib import Path

import pytest
from tests.fixtures.server.postgres import PASSWORD, SYSTEM, WHEEL, programs_of
from tests.replicas.fault_run import postgres_in
from tests.replicas.standby import failover_run, standby_of, url_of_both

from cairn_map.errors import BadInputError
from cairn_server.store.postgres.store import PgStore

pytestmark = [pytest.mark.processes, pytest.mark.slow]


def test_robots_meet_no_standby_and_go_on_when_it_becomes_the_primary(tmp_path: Path) -> None:
    found = failover_run(tmp_path, programs_of(SYSTEM), seconds=3.0, behind_s=2.0)
    said = "\n".join(f"{what}: {value}" for what, value in found.rows())
    assert found.is_sound, said
    assert found.frames["delta"] > 5, said


def test_a_url_that_reaches_a_standby_alone_is_refused_and_one_with_its_primary_works() -> None:
    programs = programs_of(WHEEL)
    with postgres_in(programs) as primary:
        primary.execute("CREATE DATABASE cairn")
        with standby_of(primary, programs, behind_s=0.0) as standby:
            for url, why in (
                (standby.url("cairn"), "it is a standby"),
                (url_of_both(standby, standby), "it is a standby"),
                (f"{url_of_both(standby, primary)}?target_session_attrs=any", "leave target_session_attrs=any out"),
            ):
                with pytest.raises(BadInputError) as refused:
                    PgStore(url)
                assert refused.value.kind == "bad_store" and why in refused.value.message
                assert f"127.0.0.1:{standby.port}" in refused.value.message and PASSWORD not in refused.value.message
            with closing(PgStore(url_of_both(standby, primary))) as store:
                assert store.maps() == []
