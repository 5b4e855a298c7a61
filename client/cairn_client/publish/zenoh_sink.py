"""Publishing through a zenoh router: nodes of rmw_zenoh, and of DDS behind zenoh-bridge-ros2dds, get the map as topics.

    cairn  -->  0/map/nav_msgs::msg::dds_::OccupancyGrid_/HASH      nodes of rmw_zenoh
           -->  map                                                 nodes behind a bridge of DDS

No ROS is needed here. A topic's newest message is kept for nodes that come late, as `rmw_zenoh` keeps it. Under a key
that no node asks for, nothing leaves this machine but the first message. Humble's nodes ask for keys without hashes:
once one of them is on the network, messages go under these.
"""

import logging
import struct
import threading
import uuid
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import zenoh
from zenoh import ext

from cairn_client.links.zenoh_keys import (
    NO_HASH,
    bridged_key,
    has_no_hash,
    message_key,
    node_token,
    publisher_token,
    tokens_of,
)
from cairn_client.links.zenoh_link import CONNECT_S, LOOK_S, is_linked, open_session, router_of
from cairn_client.publish.newest_messages import NewestMessages
from cairn_fusion.ros.bag import Topic, Wire
from cairn_fusion.ros.map_messages import MapMessage, hash_of
from cairn_fusion.ros.messages import plain_type
from cairn_map.errors import BadInputError

log = logging.getLogger(__name__)

ATTACHMENT = struct.Struct("<qqB16s")
"""Attachment of rmw_zenoh's messages: number from 1 on, nanoseconds, length of the publisher's id, and the id."""
HEARTBEAT_S = 0.5
"""Time after which a node hears of a message that it missed, and asks for it."""
AGAIN_S = 2.0
"""Pause after an error of zenoh."""


@dataclass(slots=True)
class _Publisher:
    """Publishers of one topic, one for each form of its key."""

    declared: list[Any]
    token: Any
    sender: bytes
    """Its id, 16 bytes."""
    number: int = 0
    """Number of its last message."""


class ZenohSink:
    """Sink for a `with` block; messages may be sent from any thread."""

    def __init__(self, url: str) -> None:
        """Args: url: zenoh://HOST:PORT, perhaps with ?domain=N.

        Raises:
            BadInputError: kind `bad_url`: it is none.
        """
        router = router_of(url)
        if router is None:
            raise BadInputError(
                "bad_url", f"--zenoh takes the URL of a router, zenoh://HOST:PORT?domain=0; got {url!r:.200}"
            )
        self._router = router
        self._newest = NewestMessages()
        self._publishers: dict[str, _Publisher] = {}
        self._has_humble = threading.Event()
        self._closing = threading.Event()

    def __enter__(self) -> Self:
        """Connect.

        Raises:
            BadInputError: kind `no_router`: none answers there.
        """
        self._session = open_session(self._router)
        liveliness, domain = self._session.liveliness(), self._router.domain
        self._zid = str(self._session.info.zid())
        self._node = liveliness.declare_token(node_token(domain, self._zid))
        self._tokens = liveliness.declare_subscriber(tokens_of(domain)[0], self._take_token, history=True)
        self._thread = threading.Thread(target=self._send_all, name="cairn-zenoh", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._closing.set()
        self._thread.join(CONNECT_S + 1)
        self._session.close()  # type: ignore[no-untyped-call]

    def send(self, message: MapMessage) -> None:
        """Let a message be sent, in the place of one of its topic that waits."""
        self._newest.put(message)

    def _take_token(self, sample: "zenoh.Sample") -> None:
        """Note that a node of Humble is there; in a thread of zenoh's, which may declare nothing."""
        if has_no_hash(str(sample.key_expr)):
            self._has_humble.set()

    def _send_all(self) -> None:
        """Send until `__exit__`, and all again after the link was lost or a node of Humble came.

        What fails is tried again after a pause; from `__exit__` on all that waits is tried once more.
        """
        was_linked, had_humble = True, False
        while True:
            message = self._newest.take(within_s=LOOK_S)
            try:
                if self._has_humble.is_set() and not had_humble:
                    self._undeclare()
                    self._newest.put_again()
                    had_humble = True
                if message is not None:
                    self._put(message)
                elif self._closing.is_set():
                    return
                is_there = is_linked(self._session)
                if is_there != was_linked:
                    log.warning("the link to %s is %s", self._router.url, "there again" if is_there else "lost")
                    self._newest.put_again()
                was_linked = is_there
            except zenoh.ZError as exc:
                log.warning("%s: %s", self._router.url, exc)
                if not self._closing.is_set():
                    self._closing.wait(AGAIN_S)
                    if message is not None:
                        self._newest.put_again(message.topic)

    def _put(self, message: MapMessage) -> None:
        publisher = self._publishers.get(message.topic)
        if publisher is None:
            publisher = self._publishers[message.topic] = self._declare(message)
        publisher.number += 1
        attachment = ATTACHMENT.pack(publisher.number, message.time_ns, len(publisher.sender), publisher.sender)
        for declared in publisher.declared:
            declared.put(message.data, attachment=attachment)

    def _declare(self, message: MapMessage) -> _Publisher:
        """Publishers of a topic that keep its newest message, and the token by which nodes see them."""
        topic = Topic(message.topic, plain_type(message.type_name), Wire.CDR, 0)
        type_hash = NO_HASH if self._has_humble.is_set() else hash_of(message.type_name)
        domain, number = self._router.domain, len(self._publishers) + 1
        declared = [
            ext.declare_advanced_publisher(
                self._session,
                key,
                # A message that is too large for what waits already is sent all the same: here is a thread for it.
                congestion_control=zenoh.CongestionControl.BLOCK,
                cache=ext.CacheConfig(1),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
                publisher_detection=True,
            )
            for key in (message_key(domain, topic, type_hash), bridged_key(topic))
        ]
        token = publisher_token(domain, self._zid, number, topic, type_hash)
        return _Publisher(declared, self._session.liveliness().declare_token(token), uuid.uuid4().bytes)

    def _undeclare(self) -> None:
        """Withdraw all publishers; after an error those that are left."""
        while self._publishers:
            _, publisher = self._publishers.popitem()
            publisher.token.undeclare()
            for declared in publisher.declared:
                declared.undeclare()
