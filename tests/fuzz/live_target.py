"""Frames of a Foxglove bridge, and the messages in them, through the door and the assembler of live scans."""

from collections.abc import Iterable

import numpy as np
from tests.fixtures.fusion.drive_mapping import TOPICS, mapping_text
from tests.fuzz.sections import sections_of

from cairn_client.live.foxglove_frames import MessageData, read_frame
from cairn_fusion.ros.bag import BagMessage
from cairn_fusion.ros.live_scans import LiveScans, ReadyScan
from cairn_fusion.ros.topic_mapping import mapping_from_yaml

MAPPING = mapping_from_yaml(mapping_text(), "it")
NAMES = sorted(TOPICS)
TEXT = "text"


def count_whole(ready: Iterable[ReadyScan]) -> int:
    """Count of ready scans, each of which holds its own image."""
    scans = list(ready)
    assert all(MAPPING.cameras[one.found.camera].topic in one.messages for one in scans)
    return len(scans)


def read_live(data: bytes) -> None:
    """`=== text` or `=== binary`, then a frame, one after the other: each is refused, or goes to the assembler."""
    scans = LiveScans("it", MAPPING, TOPICS)
    images = 0
    with np.errstate(all="ignore"):
        for n, (name, content) in enumerate(sections_of(data)):
            frame = read_frame(content.decode(errors="replace") if name == TEXT else content)
            if isinstance(frame, MessageData):
                scans.add(BagMessage(NAMES[frame.subscription % len(NAMES)], n, frame.data), float(n))
                images += count_whole(scans.ready(float(n)))
        images += count_whole(scans.ready(np.inf, is_over=True))
    assert images + sum(scans.left_out.values()) == sum(scans.arrived.values())
