"""Link to a Foxglove bridge: its URL, the handshake, and errors that say what is there instead.

    ws://HOST:PORT      wss://HOST:PORT, whose certificate must hold

Both subprotocols are offered: `foxglove.sdk.v1` (bridges of today) and `foxglove.websocket.v1` (ROS 1, older ones).
"""

import ssl
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

from websockets.exceptions import InvalidHandshake, InvalidMessage, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from cairn_map.errors import BadInputError

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
LINK_ERRORS: tuple[type[Exception], ...] = (OSError, WebSocketException)
"""Errors of a link that broke."""
MESSAGE_BYTES_MAX = 64 << 20
"""Largest frame; a cloud of a million points with 48 bytes each has less."""
FRAMES_MAX = 16
"""Frames that the library reads ahead; beyond them the bridge drops the oldest without a word."""
CONNECT_S = 2.5
"""Longest wait for the bridge's answer."""
BRIDGE_HELP = (
    "start one on the robot: sudo apt install ros-$ROS_DISTRO-foxglove-bridge; "
    "ros2 launch foxglove_bridge foxglove_bridge_launch.xml"
)


def is_bridge_url(url: str) -> bool:
    """True if a URL may be a bridge's."""
    return url_parts(url, "ws") is not None or url_parts(url, "wss") is not None


def url_parts(url: str, scheme: str) -> SplitResult | None:
    """Parts of SCHEME://HOST:PORT, with a host and a port that there may be; None: it is none."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
        host.encode("idna")  # as the system's resolver will
    except ValueError:
        return None
    return parts if parts.scheme == scheme and host and port != 0 and "\0" not in host else None


def certificate_checks(url: str, ca_file: Path | None) -> ssl.SSLContext | None:
    """Checks of the certificate of wss://, by an issuer's file in PEM or by what this machine trusts; None for ws://.

    Raises:
        BadInputError: kind `bad_option`: ws:// has no certificate; `no_file`: the file holds no issuer's.
    """
    if not url.startswith("wss:"):
        if ca_file is not None:
            raise BadInputError("bad_option", f"--ca is the issuer of a certificate of wss://; {url!r:.100} has none")
        return None
    try:
        return ssl.create_default_context(cafile=ca_file)
    except OSError as exc:  # SSLError is one
        said = exc.strerror or str(exc)
        raise BadInputError("no_file", f"{ca_file} holds no issuer's certificate in PEM: {said}") from exc


def connect_bridge(stack: ExitStack, url: str, checks: ssl.SSLContext | None) -> ClientConnection:
    """A link that is closed with the stack.

    Raises:
        BadInputError: kind `no_bridge`: no server answers there; `no_foxglove`: another one does; `bad_certificate`.
    """
    try:
        link = stack.enter_context(
            connect(
                url,
                subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
                compression=None,
                max_size=MESSAGE_BYTES_MAX,
                max_queue=FRAMES_MAX,
                open_timeout=CONNECT_S,
                close_timeout=1,
                proxy=None,
                ssl=checks,
            )
        )
    except ssl.SSLCertVerificationError as exc:
        raise BadInputError(
            "bad_certificate",
            f"{url} shows a certificate that does not hold ({exc.verify_message}): name its issuer's file with "
            "--ca FILE, and the host as the certificate does",
        ) from exc
    except (InvalidHandshake, InvalidMessage) as exc:
        raise BadInputError("no_foxglove", f"{url} answers, but is no Foxglove bridge ({exc}); {BRIDGE_HELP}") from exc
    except (OSError, InvalidURI, WebSocketException) as exc:
        said = str(exc) or type(exc).__name__
        raise BadInputError("no_bridge", f"no Foxglove bridge answers at {url} ({said}); {BRIDGE_HELP}") from exc
    if link.subprotocol not in SUBPROTOCOLS:
        stack.close()
        raise BadInputError(
            "no_foxglove",
            f"{url} speaks none of {', '.join(SUBPROTOCOLS)} (rosbridge is another program); {BRIDGE_HELP}",
        )
    return link
