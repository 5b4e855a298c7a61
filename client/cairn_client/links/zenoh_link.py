"""Link to a zenoh router, as its client: its URL, the session, and the error that says how to start one.

    zenoh://HOST:PORT?domain=0      that of `rmw_zenohd`, or of zenoh-bridge-ros2dds: port 7447

zenoh makes a lost link again by itself, and declares what was declared.
"""

from typing import NamedTuple

import zenoh

from cairn_client.links.link_url import domain_of, url_parts
from cairn_map.errors import BadInputError

PORT = 7447
DOMAIN = 0
MESSAGE_BYTES_MAX = 64 << 20
"""Largest message; a cloud of a million points with 48 bytes each has less."""
CONNECT_S = 2.5
LOOK_S = 0.25
"""Time between two looks whether the router is there."""
ROUTER_HELP = (
    "start one on the robot: `ros2 run rmw_zenoh_cpp rmw_zenohd` where RMW_IMPLEMENTATION is rmw_zenoh_cpp, else "
    "`zenoh-bridge-ros2dds`"
)


class Router(NamedTuple):
    """Router that a URL names."""

    url: str
    endpoint: str
    """Its address, in zenoh's form."""
    domain: int
    """ROS_DOMAIN_ID of the nodes of rmw_zenoh."""


def router_of(url: str) -> Router | None:
    """Router of zenoh://HOST:PORT, perhaps with ?domain=N; None: it is no such URL."""
    parts = url_parts(url, "zenoh")
    if parts is None or parts.path.strip("/") or parts.fragment or parts.username:
        return None
    try:
        domain = domain_of(parts.query) if parts.query else DOMAIN
    except ValueError:
        return None
    host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
    return Router(url, f"tcp/{host}:{parts.port or PORT}", domain)


def open_session(router: Router) -> zenoh.Session:
    """Session of a client of one router: it looks for no other, and listens to none.

    Raises:
        BadInputError: kind `no_router`: none answers there.
    """
    config = zenoh.Config()
    for key, value in (
        # A peer sees nothing behind rmw_zenoh's router, which does not forward between peers.
        ("mode", '"client"'),
        ("connect/endpoints", f'["{router.endpoint}"]'),
        ("connect/timeout_ms", str(round(CONNECT_S * 1000))),
        ("scouting/multicast/enabled", "false"),
        ("scouting/gossip/enabled", "false"),
        ("transport/link/rx/max_message_size", str(MESSAGE_BYTES_MAX)),
    ):
        config.insert_json5(key, value)
    try:
        return zenoh.open(config)
    except zenoh.ZError as exc:
        said = str(exc).split(" at ")[0][:200]
        raise BadInputError("no_router", f"no zenoh router answers at {router.url} ({said}); {ROUTER_HELP}") from exc


def is_linked(session: zenoh.Session) -> bool:
    """True if the router is there now."""
    return bool(session.info.routers_zid())
