"""YAML as calibration programs write it: read with care, written so that all of them read it back to the last bit.

Every text is read as YAML 1.2, whatever version its head states: in 1.1 `1e-05` is a word, and `no` is not. OpenCV
heads its files `%YAML:1.0`, which is no YAML (opencv#22118), and tags its matrices; both are read, and written texts
begin as YAML 1.1, which OpenCV takes as well. A number is written with the fewest digits that come back as the same
number, and always with a point.
"""

import re
from collections.abc import Iterable

from cairn_calib.exchange.placed_camera import KIND, TEXT_BYTES_MAX
from cairn_map.errors import BadInputError

HEAD = re.compile(r"\A\ufeff?%YAML[: ]1\.\d[^\n]*\n")
MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"
SHOWN_MAX = 200


def document_of_yaml(text: str) -> object:
    """Content of a YAML text: plain data, and OpenCV's matrices as mappings `rows`, `cols`, `dt`, `data`.

    Raises:
        ValueError: it is no YAML; the message says where, in one line.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.constructor import SafeConstructor
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.nodes import MappingNode, Node

    class Constructor(SafeConstructor):
        def matrix(self, node: Node) -> object:
            return self.construct_mapping(node, deep=True) if isinstance(node, MappingNode) else None

    Constructor.add_constructor(MATRIX_TAG, Constructor.matrix)
    reader = YAML(typ="safe", pure=True)
    reader.Constructor = Constructor
    try:
        return reader.load(HEAD.sub("", text))
    except RecursionError as exc:
        raise ValueError("nested too deep") from exc
    except (YAMLError, ValueError, TypeError, LookupError, AssertionError) as exc:
        raise ValueError(" ".join(str(exc).split())[:SHOWN_MAX]) from exc


def read_yaml(text: str, *, name: str) -> dict[str, object]:
    """The mapping in a YAML text.

    Raises:
        BadInputError: it is no YAML, or no mapping with words for keys.
    """
    if len(text) > TEXT_BYTES_MAX:
        raise BadInputError(KIND, f"{name} must be at most {TEXT_BYTES_MAX} bytes, got {len(text)}")
    try:
        document = document_of_yaml(text)
    except ValueError as exc:
        raise BadInputError(KIND, f"{name} is no YAML: {exc}") from exc
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
