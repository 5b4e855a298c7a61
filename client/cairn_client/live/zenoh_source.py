"""Door of zenoh: ROS 2 over rmw_zenoh, or DDS behind zenoh-bridge-ros2dds; through a router, as its client.

    zenoh://HOST:PORT?domain=0      see `zenoh_link`

Publishers announce themselves by liveliness tokens (`zenoh_keys`); a topic is subscribed as soon as there is one, once
for all its publishers. Messages that publishers keep for those who come late, as of /tf_static, are asked for. zenoh
calls back in the thread that reads its link, which only puts into the inbox; it also makes lost links again.
"""

import logging
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import zenoh
from zenoh import ext

from cairn_client.links.zenoh_keys import Publisher, publisher_of, tokens_of
from cairn_client.links.zenoh_link import CONNECT_S, LOOK_S, is_linked, open_session, router_of
from cairn_client.live.inbox import Inbox
from cairn_client.live.live_source import LiveSource, bad_url
from cairn_fusion.ros.bag import Topic
from cairn_fusion.ros.bag_index import STATIC_NAME

log = logging.getLogger(__name__)

TOKENS_MAX = 10_000
"""Most publishers that are known; more are left aside."""
SENDERS_MAX = 10_000
LATCHED_MAX = 16
"""Messages that are asked of each publisher that keeps some: each node has a publisher of /tf_static of its own."""
NUMBER = struct.Struct("<q")
"""Sequence number, the head of rmw_zenoh's attachment; the publisher's id is its end."""
ATTACHMENT_BYTES = 33


class ZenohSource(LiveSource):
    """Live source behind one router."""

    def __init__(self, url: str, *, inbox: Inbox | None = None, steady_s: Callable[[], float] = time.monotonic) -> None:
        """Args: url: zenoh://HOST:PORT, perhaps with ?domain=N.

        Raises:
            BadInputError: kind `bad_url`: it is none.
        """
        router = router_of(url)
        if router is None:
            raise bad_url(url)
        super().__init__(url, inbox=inbox, steady_s=steady_s)
        self._router = router
        self._tokens: dict[str, Publisher] = {}
        self._subscribers: dict[str, Any] = {}
        """Subscriptions by key, those to the tokens included."""
        self._missed: Counter[str] = Counter()
        self._numbers: dict[tuple[str, bytes], int] = {}
        """Sequence number of the last message, by topic and publisher."""
        self._session: Any = None
        self._closing = threading.Event()
        self._changed = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def topics(self) -> dict[str, Topic]:
        """Topics that are offered now, by name."""
        with self._lock:
            return {publisher.topic.name: publisher.topic for publisher in reversed(list(self._tokens.values()))}

    @property
    def dropped(self) -> Counter[str]:
        """Messages that went for room here, or that the network lost by rmw_zenoh's own numbers; by topic."""
        with self._lock:
            return self._inbox.dropped + self._missed

    def _connect(self) -> None:
        self._session = open_session(self._router)
        self._note_link(is_there=True)
        for tokens in tokens_of(self._router.domain):
            self._subscribers[tokens] = self._session.liveliness().declare_subscriber(
                tokens, self._take_token, history=True
            )
        self._thread = threading.Thread(target=self._look_after, name="cairn-live", daemon=True)
        self._thread.start()

    def _disconnect(self) -> None:
        self._closing.set()
        self._changed.set()
        if self._thread is not None:
            self._thread.join(CONNECT_S + 1)
        if self._session is not None:
            self._session.close()
            self._session = None

    def _take_token(self, sample: "zenoh.Sample") -> None:
        """Note that a publisher came or went; in a thread of zenoh's, which may declare nothing."""
        token = str(sample.key_expr)
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._tokens.pop(token, None)
            elif len(self._tokens) < TOKENS_MAX and (publisher := publisher_of(token)) is not None:
                self._tokens[token] = publisher
        self._changed.set()

    def _look_after(self) -> None:
        """Subscribe to topics that come, and see whether the router is there, until `close`."""
        while not self._closing.is_set():
            self._changed.wait(LOOK_S)
            self._changed.clear()
            try:
                self._subscribe_new()
                self._note_link(is_there=is_linked(self._session))
            except zenoh.ZError as exc:
                log.info("%s: %s", self.url, exc)

    def _subscribe_new(self) -> None:
        with self._lock:
            publishers = {one.topic.name: one for one in reversed(list(self._tokens.values()))}
        for publisher in publishers.values():
            if publisher.key not in self._subscribers and not self._closing.is_set() and self._wanted(publisher.topic):
                self._subscribers[publisher.key] = self._subscribe(publisher)

    def _subscribe(self, publisher: Publisher) -> Any:
        topic = publisher.topic.name

        def take(sample: "zenoh.Sample") -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                self._count_missed(topic, sample.attachment)
                self._inbox.receive(topic, bytes(sample.payload))

        # In zenoh's own thread: with a thread for each topic, messages of two topics come in another order than they
        # were sent, and a scan goes on without the image that was sent before the next one.
        handler = zenoh.handlers.Callback(take, indirect=False)
        if not (publisher.is_latched or STATIC_NAME in topic):
            return self._session.declare_subscriber(publisher.key, handler)
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=LATCHED_MAX)
        return ext.declare_advanced_subscriber(self._session, publisher.key, handler, history=history)

    def _count_missed(self, topic: str, attachment: "zenoh.ZBytes | None") -> None:
        """Count the messages between the last number of a publisher and this one."""
        if attachment is None or len(attachment) != ATTACHMENT_BYTES:
            return
        raw = bytes(attachment)
        sender, number = (topic, raw[-16:]), NUMBER.unpack_from(raw)[0]
        with self._lock:
            last = self._numbers.pop(sender, None)
            if last is not None and number > last + 1:
                self._missed[topic] += number - last - 1
            self._numbers[sender] = number if last is None else max(last, number)
            while len(self._numbers) > SENDERS_MAX:
                del self._numbers[next(iter(self._numbers))]
