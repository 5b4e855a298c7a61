"""Joining this server to another: the relay is a robot's program, found as `cairn` finds its commands."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

from cairn_map.errors import BadInputError
from cairn_server.operations.local_peer import OwnMaps
from cairn_server.service import Service

GROUP = "cairn.upstream"
UPSTREAM_VARIABLE = "CAIRN_UPSTREAM_TOKEN"


def add_upstream_arguments(parser: argparse.ArgumentParser) -> None:
    """`--upstream` and what belongs to it."""
    parser.add_argument("--upstream", metavar="URL", help="server to hold the same commits as (http://BASE:8750)")
    parser.add_argument(
        "--upstream-token-file", type=Path, metavar="FILE", help=f"its token of role relay (or ${UPSTREAM_VARIABLE})"
    )
    parser.add_argument(
        "--trust-server",
        action="append",
        default=[],
        metavar="KEY",
        help="key of a server whose operators' retracts, brought by a relay, count here; may be repeated",
    )


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
