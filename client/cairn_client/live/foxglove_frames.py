"""Frames of the Foxglove WebSocket protocol that a client which only listens needs, read out of untrusted bytes.

    text     {"op": "serverInfo" | "advertise" | "unadvertise" | "status", ...}
    binary   0x01 | subscription u32 | time u64, ns | message                      little-endian

Both subprotocols, `foxglove.websocket.v1` (ROS 1 bridges, older ones of ROS 2) and `foxglove.sdk.v1`, write these so.
Schemas are not used: the types of ROS are known (`cairn_fusion.ros.messages`). What has another op is of no concern.
"""

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from cairn_fusion.ros.bag import Topic, Wire
from cairn_fusion.ros.messages import plain_type
from cairn_map.errors import DamagedDataError

TEXT_BYTES_MAX = 4 << 20
"""Largest text frame: the schemas of a thousand channels. As objects of Python it may take 20 times that."""
CHANNELS_MAX = 10_000
"""Most channels of one frame, and of one bridge."""
NAME_MAX = 1024
MESSAGE_DATA = 1
MESSAGE_HEAD = struct.Struct("<BIQ")
ERROR_LEVEL = 2
WIRES = {"cdr": Wire.CDR, "ros1": Wire.ROS1}


@dataclass(frozen=True, slots=True)
class BridgeInfo:
    """First frame of a server."""

    name: str


@dataclass(frozen=True, slots=True)
class Advertised:
    """Channels that a server offers from here on, by their ids."""

    channels: dict[int, Topic]


@dataclass(frozen=True, slots=True)
class Withdrawn:
    """Channels that a server offers no more."""

    channel_ids: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ServerError:
    """Complaint of a server, as about a subscription that it does not take."""

    message: str


@dataclass(frozen=True, slots=True)
class MessageData:
    """Message of a subscription."""

    subscription: int
    data: memoryview


Frame = BridgeInfo | Advertised | Withdrawn | ServerError | MessageData


def read_frame(frame: str | bytes) -> Frame | None:
    """A frame of a server; None: one of no concern.

    Raises:
        DamagedDataError: it is none of this protocol.
    """
    return _read_text(frame) if isinstance(frame, str) else _read_binary(frame)


def subscribe_text(subscriptions: Iterable[tuple[int, int]]) -> str:
    """Text that asks for messages: pairs of a subscription's new id and its channel's."""
    listed = [{"id": number, "channelId": channel} for number, channel in subscriptions]
    return json.dumps({"op": "subscribe", "subscriptions": listed})


def unsubscribe_text(subscriptions: Iterable[int]) -> str:
    """Text that ends subscriptions."""
    return json.dumps({"op": "unsubscribe", "subscriptionIds": list(subscriptions)})


def _read_binary(frame: bytes) -> MessageData | None:
    if not frame or frame[0] != MESSAGE_DATA:
        return None
    if len(frame) < MESSAGE_HEAD.size:
        raise DamagedDataError("bad_frame", f"a message has {MESSAGE_HEAD.size} bytes or more, got {len(frame)}")
    _, subscription, _ = MESSAGE_HEAD.unpack_from(frame)
    return MessageData(subscription, memoryview(frame)[MESSAGE_HEAD.size :])


def _read_text(frame: str) -> Frame | None:
    if len(frame) > TEXT_BYTES_MAX:
        raise DamagedDataError("bad_frame", f"a text has {TEXT_BYTES_MAX} characters at most, got {len(frame)}")
    try:
        content = json.loads(frame)
    except (ValueError, RecursionError) as exc:
        raise DamagedDataError("bad_frame", f"a text is no JSON: {str(exc)[:200]}") from exc
    if not isinstance(content, dict) or not isinstance(content.get("op"), str):
        raise DamagedDataError("bad_frame", f"a text has no op: {frame[:100]!r}")
    try:
        return _of_op(content)
    except (KeyError, TypeError, ValueError) as exc:
        raise DamagedDataError("bad_frame", f"{content['op'][:40]!r} lacks what it should have: {exc!r:.200}") from exc


def _of_op(content: dict[str, Any]) -> Frame | None:
    match content["op"]:
        case "serverInfo":
            return BridgeInfo(str(content.get("name", ""))[:NAME_MAX])
        case "advertise":
            channels = content["channels"]
            if not isinstance(channels, list) or len(channels) > CHANNELS_MAX:
                raise ValueError(f"a list of at most {CHANNELS_MAX} channels is expected")
            return Advertised({_number(channel["id"]): _topic(channel) for channel in channels})
        case "unadvertise":
            return Withdrawn(tuple(_number(number) for number in content["channelIds"]))
        case "status" if content.get("level") == ERROR_LEVEL:
            return ServerError(str(content.get("message", ""))[:NAME_MAX])
    return None


def _topic(channel: Any) -> Topic:
    name, kind, encoding = channel["topic"], channel.get("schemaName", ""), channel["encoding"]
    if not isinstance(name, str) or not isinstance(kind, str) or not isinstance(encoding, str):
        raise TypeError("topic, schemaName and encoding are texts")
    if max(len(name), len(kind)) > NAME_MAX:
        raise ValueError(f"names have {NAME_MAX} characters at most")
    return Topic(name, plain_type(kind), WIRES.get(encoding), 0)


def _number(value: Any) -> int:
    if not isinstance(value, int) or not 0 <= value < 1 << 64:
        raise ValueError(f"{value!r:.40} is no id")
    return value
