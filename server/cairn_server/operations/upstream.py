"""Joining this server to another: the relay is a robot's program, found as `cairn` finds its commands."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from typing import Protocol

from cairn_map.errors import BadInputError
from cairn_server.operations.local_peer import OwnMaps
from cairn_server.service import Service

GROUP = "cairn.upstream"


class Relay(Protocol):
    """What was started."""

    def wake(self) -> None:
        """There is something new here."""
        ...

    def stop(self) -> None:
        """End soon."""
        ...


@contextmanager
def joined(service: Service) -> Iterator[None]:
    """Hold the same commits as the upstream server, if one is set, for the length of a `with`.

    Raises:
        BadInputError: kind `bad_setting`: the relay is not installed; or `bad_url`.
    """
    settings = service.settings
    if settings.upstream is None:
        yield
        return
    point = next(iter(entry_points(group=GROUP)), None)
    if point is None:
        raise BadInputError(
            "bad_setting", f"--upstream: no package offers a relay (entry points {GROUP}); install anew"
        )
    relay: Relay = point.load()(settings.upstream, settings.upstream_token, OwnMaps(service))
    service.joining.wake = relay.wake
    try:
        yield
    finally:
        relay.stop()
