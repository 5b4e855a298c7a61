"""Vectors of the ROS 2 of this Python: bytes and hashes of each message, written into `ros2_vectors.json`.

$ .venv-ros2/bin/python -m tests.ros2.vectors kilted
"""

import json
import sys
from pathlib import Path

from rclpy.serialization import serialize_message
from tests.fixtures.fusion.ros2_messages import MESSAGES, VECTORS
from tests.ros2.ros_messages import ros_message


def hash_of(kind: str) -> str:
    """Hash of a type, as the distribution's own files have it."""
    package, _, name = kind.partition("/msg/")
    path = Path(sys.prefix) / "share" / package / "msg" / f"{name}.json"
    found = json.loads(path.read_text())["type_hashes"]
    return next(str(one["hash_string"]) for one in found if one["type_name"] == kind)


def main() -> None:
    """Write the vectors of a distribution next to those of others."""
    known = json.loads(VECTORS.read_text()) if VECTORS.exists() else {}
    known[sys.argv[1]] = {
        kind: {"hash": hash_of(kind), "bytes": bytes(serialize_message(ros_message(kind, values))).hex()}
        for kind, values in MESSAGES.items()
    }
    VECTORS.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n")


if __name__ == "__main__":
    main()
