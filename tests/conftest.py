"""Order of the files (slowest first, so that no worker has one left when others are done), stores, signals, laws."""

import os
import signal
import ssl
from collections.abc import Iterator
from importlib import import_module
from typing import Any

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
    "tests/replicas/test_replicas.py",
    "tests/test_pages.py",
    "tests/fuzz/test_fuzz.py",
    "tests/replicas/test_lost_tail.py",
    "tests/cairn_client/robot/test_simulated.py",
    "tests/test_rolling_restart.py",
    "tests/cairn_sim/experiment/test_experiment.py",
    "tests/replicas/test_standby.py",
    "tests/cairn_calib/corner_search/test_coded_boards.py",
    "tests/links/test_links.py",
    "tests/cairn_calib/board/discs/test_disc_finding.py",
    "tests/links/test_namespaces.py",
    "tests/cairn_client/http/test_bombs.py",
    "tests/replicas/test_races.py",
    "tests/cairn_server/operations/test_object_commands.py",
    "tests/replicas/test_silent_cut.py",
    "tests/console/test_picture.py",
    "tests/console/test_looking.py",
    "tests/console/test_large_maps.py",
    "tests/console/test_page.py",
    "tests/console/test_tabs.py",
    "tests/console/",
)
"""Files and folders by their time on two cores, those that mostly wait among those that compute.

All of the browser's stand together: a worker that leaves them ends the room that they look at, and makes it again.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def rank(item: pytest.Item) -> int:
        path = item.nodeid.partition("::")[0]
        return next((n for n, slow in enumerate(SLOWEST) if path.startswith(slow)), len(SLOWEST))

    items.sort(key=rank)


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


@pytest.fixture(scope="session", autouse=True)
def authorities_are_read_once() -> Iterator[None]:
    """Give all HTTP clients that trust the usual authorities one context: to read these takes 20 ms of a core.

    Tests make thousands of clients, and most speak to http:// alone.
    """
    transports: Any = import_module("httpx._transports.default")
    make = transports.create_ssl_context
    kept: dict[object, ssl.SSLContext] = {}

    def context(verify: Any = True, cert: Any = None, trust_env: bool = True) -> ssl.SSLContext:
        if verify is not True or cert is not None:
            own: ssl.SSLContext = make(verify=verify, cert=cert, trust_env=trust_env)
            return own
        named = (trust_env, os.environ.get("SSL_CERT_FILE"), os.environ.get("SSL_CERT_DIR"))
        if named not in kept:
            kept[named] = make(verify=verify, cert=cert, trust_env=trust_env)
        return kept[named]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transports, "create_ssl_context", context)
        yield
