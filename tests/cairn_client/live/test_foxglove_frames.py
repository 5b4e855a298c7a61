"""Frames of the Foxglove protocol: those of the SDK's server are read, and bytes of strangers are refused."""

import json
import struct

import pytest

from cairn_client.live.foxglove_frames import (
    Advertised,
    BridgeInfo,
    MessageData,
    ServerError,
    Withdrawn,
    read_frame,
    subscribe_text,
    unsubscribe_text,
)
from cairn_fusion.ros.bag import Topic, Wire
from cairn_map.errors import DamagedDataError

IMAGE = {
    "topic": "/depth",
    "encoding": "cdr",
    "schemaName": "sensor_msgs/msg/Image",
    "schema": "",
    "schemaEncoding": "ros2msg",
}
ADVERTISED = {
    "op": "advertise",
    "channels": [
        {"id": 1, **IMAGE},
        {"id": 7, "topic": "/old", "encoding": "ros1", "schemaName": "sensor_msgs/Image", "schema": "uint8 a"},
        {"id": 9, "topic": "/log", "encoding": "json", "schemaName": ""},
    ],
}


def test_channels_are_topics_of_ros_by_their_ids() -> None:
    assert read_frame(json.dumps(ADVERTISED)) == Advertised(
        {
            1: Topic("/depth", "sensor_msgs/Image", Wire.CDR, 0),
            7: Topic("/old", "sensor_msgs/Image", Wire.ROS1, 0),
            9: Topic("/log", "", None, 0),
        }
    )


def test_a_message_has_its_subscription_and_its_bytes() -> None:
    found = read_frame(struct.pack("<BIQ", 1, 12, 1_700_000_000_000_000_000) + b"\x00\x01\x00\x00abc")
    assert isinstance(found, MessageData)
    assert (found.subscription, bytes(found.data)) == (12, b"\x00\x01\x00\x00abc")


def test_the_other_frames_of_the_protocol() -> None:
    assert read_frame('{"op": "serverInfo", "name": "mole", "capabilities": []}') == BridgeInfo("mole")
    assert read_frame('{"op": "unadvertise", "channelIds": [1, 9]}') == Withdrawn((1, 9))
    refusal = '{"op": "status", "level": 2, "message": "Unknown channel ID: 1"}'
    assert read_frame(refusal) == ServerError("Unknown channel ID: 1")
    for ignored in (
        '{"op": "status", "level": 0, "message": "hello"}',
        '{"op": "connectionGraphUpdate"}',
        b"\x02",
        b"",
    ):
        assert read_frame(ignored) is None


def test_what_is_sent_is_what_the_protocol_asks_for() -> None:
    asked = json.loads(subscribe_text([(3, 7), (4, 1)]))
    assert asked == {"op": "subscribe", "subscriptions": [{"id": 3, "channelId": 7}, {"id": 4, "channelId": 1}]}
    assert json.loads(unsubscribe_text([3])) == {"op": "unsubscribe", "subscriptionIds": [3]}


@pytest.mark.parametrize(
    "frame",
    [
        "",
        "[]",
        "{",
        '{"op": 3}',
        "[" * 100_000,
        '{"op": "advertise"}',
        '{"op": "advertise", "channels": {}}',
        '{"op": "advertise", "channels": [3]}',
        '{"op": "advertise", "channels": [{"id": -1, "topic": "/a", "encoding": "cdr"}]}',
        '{"op": "advertise", "channels": [{"id": 1, "topic": ["/a"], "encoding": "cdr"}]}',
        '{"op": "advertise", "channels": [{"id": 1, "topic": "/' + "a" * 2000 + '", "encoding": "cdr"}]}',
        '{"op": "unadvertise", "channelIds": "all"}',
        '{"op": "serverInfo", "name": "' + "a" * (4 << 20) + '"}',
        b"\x01",
        b"\x01\0\0\0\0\0\0\0\0\0\0\0",
    ],
)
def test_other_bytes_are_refused_in_short(frame: str | bytes) -> None:
    with pytest.raises(DamagedDataError) as caught:
        read_frame(frame)
    assert caught.value.kind == "bad_frame" and len(caught.value.message) < 500
