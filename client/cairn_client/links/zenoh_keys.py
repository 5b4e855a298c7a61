"""Keys under which ROS 2 is found on zenoh: liveliness tokens of publishers, and the keys of their messages.

rmw_zenoh               @ros2_lv/DOMAIN/ZID/NODE/ID/MP/ENCLAVE/NAMESPACE/NODE_NAME/%camera%image/TYPE/HASH/QOS
                        DOMAIN/camera/image/TYPE/HASH                     TYPE: sensor_msgs::msg::dds_::Image_
zenoh-bridge-ros2dds    @/ZID/@ros2_lv/MP/camera§image/TYPE/QOS           TYPE: sensor_msgs§msg§Image
                        camera/image

HASH is of the type's definition, or `TypeHashNotSupported` (Humble); it is not compared, as these types have never
changed. What others put on the network is no key of ROS: it is left aside. A publisher of ours writes the same keys.
"""

import re
from dataclasses import dataclass

from cairn_fusion.ros.bag import Topic, Wire

RMW_ROOT, BRIDGE_ROOT, PUBLISHER = "@ros2_lv", "@", "MP"
NAME_MAX = 1024
RMW_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")
BRIDGE_TYPE = re.compile(r"(\w+)§msg§(\w+)")
TOPIC = re.compile(r"(?:/[^/\s*$?#]+)+")
"""Names of which a key can be made: none of them has a wildcard of zenoh."""
TRANSIENT_LOCAL = "1"
"""Durability of a publisher that keeps its last messages for those who come late."""
QUALITY_PARTS = 3
NO_HASH = "TypeHashNotSupported"
"""Hash of every type in Humble, whose nodes hear of no message under another one."""
NEWEST_KEPT = ":1:,1:,:,:,,"
"""Quality of a reliable publisher that keeps its newest message for those who come late."""
NODE = "NN"
NODE_NAME = "cairn"


@dataclass(frozen=True, slots=True)
class Publisher:
    """Publisher of one topic, as its liveliness token says."""

    topic: Topic
    key: str
    """Key expression of its messages."""
    is_latched: bool
    """True if it keeps its last messages for those who come late."""


def tokens_of(domain: int) -> tuple[str, str]:
    """Key expressions of all tokens: those of rmw_zenoh in a domain, and those of the bridges of DDS."""
    return f"{RMW_ROOT}/{domain}/**", f"{BRIDGE_ROOT}/*/{RMW_ROOT}/**"


def publisher_of(token: str) -> Publisher | None:
    """The publisher of a token; None: it is none of a topic."""
    if len(token) > NAME_MAX:
        return None
    parts = token.split("/")
    if parts[0] == RMW_ROOT and len(parts) >= 13 and parts[5] == PUBLISHER:
        domain, mangled, kind, quality = parts[1], parts[9], RMW_TYPE.fullmatch(parts[10]), parts[12]
        name = mangled.replace("%", "/")
        # Not the hash: a publisher of another distribution may have another one.
        key = f"{domain}{name}/{parts[10]}/*"
        durability = 1
    elif parts[0] == BRIDGE_ROOT and len(parts) >= 6 and parts[2:4] == [RMW_ROOT, PUBLISHER]:
        kind, quality = BRIDGE_TYPE.fullmatch(parts[5]), parts[6] if len(parts) > 6 else ""
        key = parts[4].replace("§", "/")
        name = f"/{key}"
        durability = 2
    else:
        return None
    if kind is None or not TOPIC.fullmatch(name):
        return None
    fields = quality.split(":")
    is_latched = len(fields) > QUALITY_PARTS and fields[durability] == TRANSIENT_LOCAL
    return Publisher(Topic(name, f"{kind[1]}/{kind[2]}", Wire.CDR, 0), key, is_latched)


def has_no_hash(token: str) -> bool:
    """True of a token of Humble's: of a publisher, a subscriber or a service without the hash of its type."""
    return token.startswith(f"{RMW_ROOT}/") and f"/{NO_HASH}/" in token


def node_token(domain: int, session: str) -> str:
    """Token of our node of rmw_zenoh; `session`: the id of its session."""
    return f"{RMW_ROOT}/{domain}/{session}/0/0/{NODE}/%/%/{NODE_NAME}"


def publisher_token(domain: int, session: str, number: int, topic: Topic, type_hash: str) -> str:
    """Token of a publisher of that node that keeps its newest message; `number`: of the publisher, from 1 on."""
    place = f"{RMW_ROOT}/{domain}/{session}/0/{number}/{PUBLISHER}/%/%/{NODE_NAME}"
    return f"{place}/{topic.name.replace('/', '%')}/{_mangled(topic.type)}/{type_hash}/{NEWEST_KEPT}"


def message_key(domain: int, topic: Topic, type_hash: str) -> str:
    """Key of a topic's messages for nodes of rmw_zenoh."""
    return f"{domain}{topic.name}/{_mangled(topic.type)}/{type_hash}"


def bridged_key(topic: Topic) -> str:
    """Key of a topic's messages for nodes of DDS behind a bridge."""
    return topic.name.removeprefix("/")


def _mangled(kind: str) -> str:
    """`sensor_msgs::msg::dds_::Image_` of sensor_msgs/Image."""
    package, _, name = kind.partition("/")
    return f"{package}::msg::dds_::{name}_"
