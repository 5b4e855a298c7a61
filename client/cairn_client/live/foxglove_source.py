"""Door of a Foxglove bridge: the topics of a live robot and their messages, through reconnects and new channel ids.

    connect -> serverInfo -> advertise -> subscribe -> message, message, ...           one thread, which only receives

Everything goes by the topic's name: a bridge that starts again, or a node that does, gets new channel ids. A
subscription that is refused because the bridge does not know its own channel yet, or that stays silent, is made again.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from websockets.sync.client import ClientConnection

from cairn_client.links.bridge_link import BridgeLinks, is_bridge_url
from cairn_client.live.foxglove_frames import (
    CHANNELS_MAX,
    Advertised,
    BridgeInfo,
    MessageData,
    ServerError,
    Withdrawn,
    read_frame,
    subscribe_text,
    unsubscribe_text,
)
from cairn_client.live.inbox import Inbox
from cairn_client.live.live_source import LiveSource, bad_url
from cairn_fusion.ros.bag import Topic
from cairn_map.errors import DamagedDataError

log = logging.getLogger(__name__)

LOOK_S = 0.1
"""Longest wait for a frame before subscriptions are looked after."""
AGAIN_S = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Pauses before a link is tried again; the last one repeats."""
REFUSED_AGAIN_S = 0.2
SILENT_AGAIN_S = 3.0
"""Pause after which a topic that brought nothing is subscribed again; doubled each time, up to a minute."""
SILENT_AGAIN_MAX_S = 60.0


@dataclass(slots=True)
class _Subscription:
    """Subscription of one topic on the present link."""

    channel: int
    number: int
    again_s: float
    """Steady time at which it is made again, if nothing came by it."""
    pause_s: float = SILENT_AGAIN_S
    messages: int = 0


class FoxgloveSource(LiveSource):
    """Live source behind one bridge."""

    def __init__(
        self,
        url: str,
        *,
        ca_file: Path | None = None,
        inbox: Inbox | None = None,
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open nothing yet.

        Args:
            url: ws://HOST:PORT or wss://HOST:PORT.
            ca_file: issuer of the certificate of wss://, PEM; None: SSL_CERT_FILE, or those that this machine trusts.
            inbox: takes the messages.
            steady_s: clock.

        Raises:
            BadInputError: kind `bad_url`: it is none; kind `no_file`: the issuer's file is none.
        """
        if not is_bridge_url(url):
            raise bad_url(url)
        super().__init__(url, inbox=inbox, steady_s=steady_s)
        self._links = BridgeLinks(url, ca_file, self._use, pauses_s=AGAIN_S, name="cairn-live")
        self._channels: dict[int, Topic] = {}
        self._subscriptions: dict[str, _Subscription] = {}
        self._by_number: dict[int, str] = {}
        self._numbers = 0

    @property
    def topics(self) -> dict[str, Topic]:
        """Topics that are offered now, by name."""
        with self._lock:
            return {topic.name: topic for topic in self._channels.values()}

    def _connect(self) -> None:
        self._links.start()

    def _disconnect(self) -> None:
        self._links.stop()

    def _use(self, link: ClientConnection) -> None:
        """Receive over one link."""
        self._note_link(is_there=True)
        try:
            self._listen(link)
        finally:
            self._note_link(is_there=False)
            with self._lock:
                self._channels, self._subscriptions, self._by_number = {}, {}, {}

    def _listen(self, link: ClientConnection) -> None:
        while not self._links.closing.is_set():
            try:
                frame = link.recv(timeout=LOOK_S)
            except TimeoutError:
                frame = None
            if frame is not None:
                try:
                    self._take_frame(link, frame)
                except DamagedDataError as exc:
                    self.damaged += 1
                    log.warning("%s: %s", self.url, exc.message)
            self._subscribe_again(link)

    def _take_frame(self, link: ClientConnection, frame: str | bytes) -> None:
        match read_frame(frame):
            case MessageData(subscription=number, data=data):
                name = self._by_number.get(number)
                if name is None:
                    return
                self._subscriptions[name].messages += 1
                self._inbox.receive(name, data)
            case Advertised(channels=channels):
                with self._lock:
                    if len(self._channels.keys() | channels.keys()) > CHANNELS_MAX:
                        raise DamagedDataError("bad_frame", f"a bridge offers at most {CHANNELS_MAX} channels")
                    self._channels |= channels
                for channel, topic in channels.items():
                    if self._wanted(topic):
                        self._subscribe(link, channel, topic.name)
            case Withdrawn(channel_ids=ids):
                with self._lock:
                    gone = [self._channels.pop(number, None) for number in ids]
                for name in {topic.name for topic in gone if topic is not None}:
                    known = self._subscriptions.get(name)
                    if known is not None and known.channel in ids:
                        del self._subscriptions[name], self._by_number[known.number]
            case ServerError(message=message):
                log.info("%s says: %s", self.url, message)
                soon_s = self._steady_s() + REFUSED_AGAIN_S
                for subscription in self._subscriptions.values():
                    if not subscription.messages:
                        subscription.again_s = min(subscription.again_s, soon_s)
            case BridgeInfo(name=name):
                log.info("%s is %s", self.url, name)

    def _subscribe(self, link: ClientConnection, channel: int, name: str, *, pause_s: float = SILENT_AGAIN_S) -> None:
        """Subscribe to a topic, in the place of the subscription that it has."""
        before = self._subscriptions.pop(name, None)
        if before is not None:
            del self._by_number[before.number]
            link.send(unsubscribe_text([before.number]))
        self._numbers += 1
        self._subscriptions[name] = _Subscription(channel, self._numbers, self._steady_s() + pause_s, pause_s)
        self._by_number[self._numbers] = name
        link.send(subscribe_text([(self._numbers, channel)]))

    def _subscribe_again(self, link: ClientConnection) -> None:
        now_s = self._steady_s()
        for name, subscription in list(self._subscriptions.items()):
            if not subscription.messages and now_s >= subscription.again_s:
                pause_s = min(2 * subscription.pause_s, SILENT_AGAIN_MAX_S)
                self._subscribe(link, subscription.channel, name, pause_s=pause_s)
