"""A short run of `tests.replicas races`, on the oldest and the newest PostgreSQL."""

import pytest
from tests.fixtures.server.postgres import SYSTEM, WHEEL, programs_of
from tests.replicas.races import races_run

pytestmark = [pytest.mark.processes, pytest.mark.slow]


@pytest.mark.parametrize("kind", [WHEEL, SYSTEM])
def test_what_two_servers_do_at_once_happens_in_one_order_or_the_other(kind: str) -> None:
    found = races_run(programs_of(kind), turns=100)
    assert found.is_sound, found.wrong[:5]
    assert min(found.ends.values()) > 5 and len(found.ends) == 4, found.ends
