"""Link to a Foxglove bridge: its URL, the handshake, errors that say what is there instead, and links that are lost.

    ws://HOST:PORT      wss://HOST:PORT, whose certificate must hold

Both subprotocols are offered: `foxglove.sdk.v1` (bridges of today) and `foxglove.websocket.v1` (ROS 1, older ones).
"""

import logging
import ssl
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from websockets.exceptions import InvalidHandshake, InvalidMessage, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from cairn_client.links.link_url import url_parts
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)

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


class BridgeLinks:
    """Links to one bridge, one after the other, each used until it breaks, in a thread of their own."""

    def __init__(
        self,
        url: str,
        ca_file: Path | None,
        use: Callable[[ClientConnection], None],
        *,
        pauses_s: Sequence[float],
        name: str,
    ) -> None:
        """Connect to nothing yet.

        Args:
            url: ws://HOST:PORT or wss://HOST:PORT.
            ca_file: issuer of the certificate of wss://, PEM; None: SSL_CERT_FILE, or those that this machine trusts.
            use: called with each link; returns once `closing` is set.
            pauses_s: pauses before a link is tried again, seconds; the last one repeats.
            name: of the thread.

        Raises:
            BadInputError: kind `bad_option` or `no_file`: the issuer's file is for no wss://, or is none.
        """
        self.closing = threading.Event()
        self._url = url
        self._checks = certificate_checks(url, ca_file)
        self._use = use
        self._pauses_s = pauses_s
        self._name = name
        self._thread: threading.Thread | None = None

    def start(self, greet: Callable[[ClientConnection], None] = lambda link: None) -> None:
        """Connect, and go on in the thread.

        Args:
            greet: called with the first link, in the caller's thread; what it raises ends the link.

        Raises:
            BadInputError: no bridge is there, see `connect_bridge`.
        """
        stack = ExitStack()
        try:
            link = connect_bridge(stack, self._url, self._checks)
            greet(link)
            thread = threading.Thread(target=self._run, args=(stack, link), name=self._name, daemon=True)
            thread.start()
        except BaseException:  # Ctrl-C, too: no thread is there to end the link
            stack.close()
            raise
        self._thread = thread

    def stop(self) -> None:
        """End the last link."""
        self.closing.set()
        if self._thread is not None:
            self._thread.join(CONNECT_S + 1)

    def _run(self, stack: ExitStack, first: ClientConnection) -> None:
        link: ClientConnection | None = first
        tries = 0
        while not self.closing.is_set():
            with stack:
                try:
                    if link is None:
                        link = connect_bridge(stack, self._url, self._checks)
                    tries = 0
                    self._use(link)
                except BadInputError as exc:
                    log.debug("%s", exc.message)
                except LINK_ERRORS as exc:
                    log.info("the link to %s is lost: %s", self._url, exc or type(exc).__name__)
            link, stack = None, ExitStack()
            self.closing.wait(self._pauses_s[min(tries, len(self._pauses_s) - 1)])
            tries += 1
