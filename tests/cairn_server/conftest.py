"""Hypothesis as in `tests/cairn_map`, and a server that trusts this machine."""

from hypothesis import HealthCheck, settings
from tests.fixtures.server.live import live
from tests.fixtures.server.object_store import object_place, object_server
from tests.fixtures.server.postgres import newest_postgres, postgres, postgres_database

__all__ = ["live", "newest_postgres", "object_place", "object_server", "postgres", "postgres_database"]

settings.register_profile(
    "cairn", max_examples=50, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cairn")
