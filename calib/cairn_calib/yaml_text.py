"""YAML as calibration programs write it: read with care, written so that all of them read it back to the last bit.

OpenCV heads its files `%YAML:1.0`, which is no YAML (opencv#22118), and tags its matrices; both are read, and what is
written here begins as YAML 1.1, which OpenCV takes as well. A number is written with the fewest digits that come back
as the same number, and always with a point: to YAML 1.1 `1e-05` is a word.
"""

import re
from collections.abc import Iterable

import yaml

from cairn_calib.placed import KIND, TEXT_BYTES_MAX
from cairn_map.errors import BadInputError

OPENCV_HEAD = re.compile(r"\A\ufeff?%YAML:1\.\d[^\n]*\n(?=---)|\A\ufeff?%YAML:1\.\d[^\n]*\n")
MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"
SHOWN_MAX = 200


class _Loader(yaml.SafeLoader):  # type: ignore[misc] # without stubs it is Any
    """Plain data and OpenCV's matrices, which are mappings `rows`, `cols`, `dt`, `data`."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> object:
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


_Loader.add_constructor(MATRIX_TAG, _matrix)


def read_yaml(text: str, *, name: str) -> dict[str, object]:
    """The mapping in a YAML text.

    Raises:
        BadInputError: it is no YAML, or no mapping with words for keys.
    """
    if len(text) > TEXT_BYTES_MAX:
        raise BadInputError(KIND, f"{name} must be at most {TEXT_BYTES_MAX} bytes, got {len(text)}")
    try:
        document = yaml.load(OPENCV_HEAD.sub("", text), Loader=_Loader)  # noqa: S506 - a SafeLoader
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as exc:
        shown = " ".join(str(exc).split())[:SHOWN_MAX] if not isinstance(exc, RecursionError) else "nested too deep"
        raise BadInputError(KIND, f"{name} is no YAML: {shown}") from exc
    if not isinstance(document, dict) or not all(isinstance(key, str) for key in document):
        raise BadInputError(KIND, f"{name} must be a YAML mapping of names to values")
    return document


def number(value: float) -> str:
    """A finite number as YAML 1.1, OpenCV and ROS all read it."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def numbers(values: Iterable[float]) -> str:
    """A list of numbers in one line."""
    return "[" + ", ".join(number(value) for value in values) + "]"
