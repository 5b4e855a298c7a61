"""Messages of the ROS 2 of this Python, from values."""

import importlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np


def type_of(kind: str) -> Any:
    """The class of `sensor_msgs/msg/Image`."""
    package, _, name = kind.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def ros_message(kind: str, values: Mapping[str, Any]) -> Any:
    """A message of ROS with these values."""
    message = type_of(kind)()
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        inner = re.sub(r"^sequence<(.*)>$", r"\1", types[name]).replace("/", "/msg/")
        if isinstance(value, Mapping):
            value = ros_message(inner, value)
        elif isinstance(value, list):
            value = [ros_message(inner, one) for one in value]
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        setattr(message, name, value)
    return message
