"""Memory of a client's process whose server sends bombs: below 200 MB, and no more than 200 bytes for one that came."""

import gzip
import json
import re
import subprocess
import sys
import zlib
from collections.abc import Iterable
from itertools import repeat

import pytest
from tests.fixtures.client.hostile_server import HostileServer, answer
from tests.fixtures.map.bombs import zeros_in_zstd

PEAK_MAX_MB = 200
HELD_PER_BYTE = 200
NOISE_MB = 16
GIB = 1 << 30
CALLS = ("map_info", "cell", "missing", "events", "export")


def zeros_in_deflate(size_bytes: int) -> bytes:
    """A raw stream of deflate without its end, of one block again and again."""
    packer = zlib.compressobj(9, wbits=-15)
    block = [packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2)][1]
    return block * (size_bytes >> 20)


def gzipped_twice() -> bytes:
    return gzip.compress(b"\x1f\x8b\x08" + bytes(6) + b"\xff" + zeros_in_deflate(GIB), mtime=0)


def json_bombs() -> dict[str, tuple[str, bytes]]:
    """By name: the request to whose answer it is made for, and the text."""
    many = 250_000
    unknown = b",".join(b'"%x":0' % n for n in range(many))
    author = b'"mole.0123456789abcdef":'
    return {
        "lists": ("branches", b"[" + b"[]," * many + b"[]]"),
        "objects": ("branches", b"[" + b"{}," * many + b"{}]"),
        "zeros": ("branches", b"[" + b"0," * (4 * many) + b"0]"),
        "fields": ("map_info", b"{" + unknown + b"}"),
        "fields-in-list": ("branches", b"[{" + unknown + b"}]"),
        "cells": ("cell_index", b'{"header":{},"cells":[' + b"{}," * many + b"{}]}"),
        "intervals": ("held", b'{"vector":{' + author + b"[" + b"[0,0]," * many + b"[0,0]]}}"),
        "authors": ("held", b'{"vector":{' + b",".join(b'"%x":[]' % n for n in range(many)) + b"}}"),
        "text": ("map_info", b'{"name":"' + b"x" * (1 << 22) + b'"}'),
    }


@pytest.fixture(scope="module")
def texts() -> dict[str, tuple[str, bytes]]:
    return json_bombs()


@pytest.fixture(scope="module")
def bombs(texts: dict[str, tuple[str, bytes]]) -> dict[str, Iterable[bytes]]:
    """Answers by the name of the map that is asked for."""
    twice, zstd = gzipped_twice(), zeros_in_zstd(GIB)
    coded = {
        "gzip-gzip": (twice, "gzip, gzip"),
        "gzip": (gzip.decompress(twice), "gzip"),
        "deflate": (zeros_in_deflate(GIB), "deflate"),
        "zstd": (zstd, "zstd"),
        "br": (b"\x81\xff\xff" * 600, "br"),
    }
    assert len(twice) < 16_384
    found: dict[str, Iterable[bytes]] = {}
    for name, (body, coding) in coded.items():
        found[name] = [answer(body, f"Content-Encoding: {coding}")]
        found[f"{name}-error"] = [answer(body, f"Content-Encoding: {coding}", status="500 x")]
    chunked = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
    found |= {
        "claims": [b"HTTP/1.1 200 OK\r\nContent-Length: 999999999999999999\r\n\r\n", b"x"],
        "heads": [b"HTTP/1.1 200 OK\r\n", *repeat(b"x: y\r\n" * 100, 600)],
        "chunk": [chunked + b"ffffffffffffffff\r\n" + b"x" * 4000],
        "drip": [chunked, *repeat(b"1\r\nx\r\n" * 100, 200)],
        "endless": [b"HTTP/1.1 200 OK\r\n\r\n", *repeat(bytes(1 << 20), 70)],
        "endless-error": [b"HTTP/1.1 500 x\r\n\r\n", *repeat(bytes(1 << 20), 70)],
    }
    return found | {name: [answer(body)] for name, (_, body) in texts.items()}


@pytest.mark.processes
def test_the_memory_of_a_client_is_bounded_whatever_answers(
    texts: dict[str, tuple[str, bytes]], bombs: dict[str, Iterable[bytes]]
) -> None:
    asked = [(call, name) for name in sorted(bombs.keys() - texts.keys()) for call in CALLS]
    asked += [(call, name) for name, (call, _) in texts.items()]

    def answer_to(head: bytes) -> Iterable[bytes]:
        found = re.match(rb"[A-Z]+ /maps/([a-z-]+)", head)
        assert found
        return bombs[found[1].decode()]

    with HostileServer(answer_to) as server:
        child = subprocess.run(
            [sys.executable, "-m", "tests.fixtures.client.answer_reader", server.url, json.dumps(asked)],
            stdout=subprocess.PIPE,
            check=True,
        )
    lines = json.loads(child.stdout)
    assert [(call, name) for call, name, *_ in lines] == asked
    too_much = []
    for call, name, kind, peak_mb, growth_mb, read_bytes in lines:
        assert kind, f"{name} was taken for an answer to {call}"
        is_small = name not in texts and "endless" not in name
        if (peak_mb > PEAK_MAX_MB and is_small) or growth_mb > NOISE_MB + (HELD_PER_BYTE * read_bytes >> 20):
            too_much.append((call, name, kind, peak_mb, growth_mb, read_bytes))
    assert too_much == []
