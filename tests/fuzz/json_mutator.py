"""JSON changed so that it stays JSON: a value, a key or an entry at a time."""

import json
import random
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

Container = Any
"""A dict or a list."""

ODD_VALUES: tuple[object, ...] = (
    *(None, True, False, 0, 1, -1, 0.5, -0.0, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 10**15, 10**400, 1e308, 1e-308),
    *(float("inf"), float("nan"), "", "0", "\x00", "\ud800", "é" * 40, "a" * 5000, "../x", "a.b.c", "f" * 32, "f" * 64),
    *([], {}, [[]], [0, 0], [1, 0], [[0, 1], [2, 3]], [0] * 5, {"a": 1}, {"": {}}, [[[[[[]]]]]]),
)


def mutated_json(data: bytes, rng: random.Random, mutate: Callable[[bytes], bytes]) -> bytes:
    """The document with one or a few changes; what is no JSON is changed as bytes."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return mutate(data)
    if rng.random() < 0.15:
        return mutate(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        containers = list(_containers(document))
        if not containers:
            return json.dumps(rng.choice(ODD_VALUES)).encode()
        _change(rng.choice(containers), rng, mutate)
    try:
        return json.dumps(document, ensure_ascii=rng.random() < 0.5).encode(errors="surrogatepass")
    except (ValueError, RecursionError):
        return mutate(data)


def _containers(document: object) -> Iterator[Container]:
    """Every object and list that is not empty."""
    left = [document]
    while left:
        value = left.pop()
        if isinstance(value, dict | list) and value:
            yield value
            left += value.values() if isinstance(value, dict) else value


def _change(container: Container, rng: random.Random, mutate: Callable[[bytes], bytes]) -> None:
    key = rng.choice(list(container) if isinstance(container, dict) else list(range(len(container))))
    way = rng.random()
    value = container[key]
    if way < 0.1:
        del container[key]
    elif way < 0.2 and isinstance(container, dict):
        container[mutate(str(key).encode(errors="replace")).decode(errors="replace")] = value
    elif way < 0.25 and isinstance(container, list):
        container += container[: rng.choice((1, 2, 40))]
    else:
        container[key] = _other(value, rng, mutate)


def _other(value: object, rng: random.Random, mutate: Callable[[bytes], bytes]) -> object:
    way = rng.random()
    if way < 0.4:
        return deepcopy(rng.choice(ODD_VALUES))
    if isinstance(value, str):
        return mutate(value.encode(errors="replace")).decode(errors="replace")
    if isinstance(value, float):
        return value * rng.choice((-1.0, 0.0, 1e-9, 0.999, 1.001, 1e9, 1e200))
    if isinstance(value, int):
        return value + rng.choice((-1000, -1, 1, 1000, 1 << rng.randrange(70)))
    return deepcopy(rng.choice(ODD_VALUES))
