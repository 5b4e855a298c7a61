"""A server that trusts this machine, databases and object stores."""

from tests.fixtures.server.live import live
from tests.fixtures.server.object_store import object_place, object_server
from tests.fixtures.server.postgres import newest_postgres, postgres, postgres_database

__all__ = ["live", "newest_postgres", "object_place", "object_server", "postgres", "postgres_database"]
