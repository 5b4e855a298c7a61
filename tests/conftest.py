"""Order of the files (slowest first, so that no worker has one left when others are done), stores, signals, laws."""

import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

# No deadline: the first call of a kernel compiles it, and the machine may be loaded.
settings.register_profile(
    "cairn", max_examples=50, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cairn")

# What fixtures assert is told as fully as what tests assert.
pytest.register_assert_rewrite("tests.fixtures")

SLOWEST = (
    "tests/test_image.py",
    "tests/test_commands.py",
    "tests/test_pages.py",
    "tests/console/test_page.py",
    "tests/fuzz/test_fuzz.py",
    "tests/cairn_sim/experiment/test_experiment.py",
    "tests/console/test_screens.py",
    "tests/console/test_access.py",
    "tests/console/test_tabs.py",
    "tests/cairn_client/robot/test_simulated.py",
    "tests/cairn_calib/board/test_board_finding.py",
)
"""By their time on two cores; the others take half a minute at most."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    ranks = {path: rank for rank, path in enumerate(SLOWEST)}
    items.sort(key=lambda item: ranks.get(item.nodeid.partition("::")[0], len(SLOWEST)))


def pytest_sessionstart() -> None:
    if os.environ.get("CAIRN_TEST_STORE") in ("postgresql", "replicas"):
        from tests.fixtures.server.database_stores import database_store
        from tests.fixtures.server.stores import OPENERS, POSTGRESQL, REPLICAS

        OPENERS.update({POSTGRESQL: database_store, REPLICAS: database_store})


@pytest.fixture(scope="session", autouse=True)
def children_hear_interrupts() -> Iterator[None]:
    """Start tests' processes with SIGINT's default, also in a suite that a shell runs in the background.

    There SIGINT is ignored, and ignoring outlives exec; a handler does not, so one that ignores it here is enough.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored:
        signal.signal(signal.SIGINT, lambda number, frame: None)
    yield
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
