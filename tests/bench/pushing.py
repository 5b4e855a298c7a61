"""Robots that push, and the server that they push to: a process of its own, spoken to over plain sockets.

Commits of a few real diffs under ever new ids: only their meta is made anew, so that robots take little of the
processors that the server has.
"""

import http.client
import json
import os
import re
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import zstandard

from cairn_client.replica.outbox import CommitFacts
from cairn_map.codec.cell_code import cell_digest
from cairn_map.codec.octree.cell_head import decode_head
from cairn_map.commits.commit import HEAD, Commit, CommitMeta, ScanPose, commit_sha, make_commit
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry
from cairn_map.wire.messages import CreateMap, MapInfo
from cairn_server.store.shares import region_of
from cairn_server.store.store_rows import NewCommit

Diff = dict[CellKey, Evidence]
BOMB_BYTES = 1 << 30


class Bodies:
    """Commits of the same diffs under ever new ids; only the meta is made anew."""

    def __init__(self, diffs: list[Diff], geometry: Geometry, *, scans: int = 1) -> None:
        """Each diff is what so many scans saw."""
        self.geometry = geometry
        self._scans = scans
        self._made = [make_commit(meta_of("mole", 0, geometry, scans), diff, geometry) for diff in diffs]
        self._digests = [[cell_digest(key, diff[key], geometry) for key in sorted(diff)] for diff in diffs]

    def body(self, robot: str, n: int, *, diff: int | None = None) -> bytes:
        """The n-th commit of a robot, of the n-th diff or of this one."""
        made = self._made[(n if diff is None else diff) % len(self._made)]
        return self._with_text(made, _text(robot, n, self.geometry, self._scans))

    def commit(self, robot: str, n: int) -> NewCommit:
        """The same as the store takes it."""
        made, text = self._made[n % len(self._made)], _text(robot, n, self.geometry, self._scans)
        meta = meta_of(robot, n, self.geometry, self._scans)
        return NewCommit(
            id=meta.commit_id,
            sha=commit_sha(text, self._digests[n % len(self._made)]),
            size_bytes=len(made.data),
            text=text,
            captured_s=None,
            retracts=(),
            diff=made.cells,
            tops=dict.fromkeys(map(region_of, made.cells), (1, 1) + (0,) * self.geometry.plane_count),
        )

    def _with_text(self, made: Commit, text: bytes) -> bytes:
        rest = made.data[HEAD.size + len(made.text) :]
        return HEAD.pack(*HEAD.unpack_from(made.data)[:2], len(text)) + text + rest


def meta_of(robot: str, n: int, geometry: Geometry, scans: int = 1) -> CommitMeta:
    """What the n-th commit of a robot says of itself."""
    pose = ScanPose(time_s=1.7e9 + n, t_map_rig=(1.0, 2.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    return CommitMeta(id=f"{robot}.{'0' * 16}.{n}", geometry=geometry.digest().hex(), scans=(pose,) * scans)


def facts_of(n: int, scans: int = 1) -> CommitFacts:
    """What a robot states in its n-th commit, as `meta_of`."""
    pose = ScanPose(time_s=1.7e9 + n, t_map_rig=(1.0, 2.0, 0.4), q_map_rig=(0.0, 0.0, 0.0, 1.0))
    return CommitFacts(scans=(pose,) * scans)


def _text(robot: str, n: int, geometry: Geometry, scans: int) -> bytes:
    return meta_of(robot, n, geometry, scans).model_dump_json(exclude_defaults=True).encode()


class Robot:
    """One connection to a server."""

    def __init__(self, server: "Server", name: str) -> None:
        self.name = name
        self._link = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        self._link.connect()
        self._link.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        body = json.dumps({"robot": name, "incarnation": "0" * 16}).encode()
        self._headers = {"Authorization": "Bearer " + server.token_of(body)}

    def push(self, commit: str, data: bytes) -> int:
        """The status of the answer."""
        return self.ask("PUT", f"/maps/bench/commits/{commit}", data)[0]

    def ask(self, method: str, path: str, data: bytes) -> tuple[int, bytes]:
        """Status and body."""
        kind = "application/json" if method == "POST" else "application/vnd.cairn.commit"
        self._link.request(method, path, data, self._headers | {"Content-Type": kind})
        answer = self._link.getresponse()
        return answer.status, answer.read()

    def close(self) -> None:
        """Close the connection."""
        self._link.close()


class Server:
    """`cairn serve` as a process of its own, with a map called bench."""

    def __init__(self, folder: Path, geometry: Geometry, *arguments: str) -> None:
        command = [sys.executable, "-m", "cairn_client.main", "serve", "--data", str(folder), "--port", "0", *arguments]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        line = self._process.stdout.readline() if self._process.stdout else ""
        found = re.search(r":(\d+)", line.partition("http://")[2])
        if found is None:
            raise RuntimeError("the server did not start")
        self.port = int(found[1])
        self.pid = self._process.pid
        self.ask("PUT", "/maps/bench", CreateMap(geometry=geometry).model_dump_json().encode())

    def ask(self, method: str, path: str, body: bytes = b"") -> bytes:
        """One request of an admin, over a connection of its own."""
        link = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        link.request(method, path, body, {"Content-Type": "application/json"})
        answer = link.getresponse().read()
        link.close()
        return answer

    def token_of(self, body: bytes) -> str:
        """Register a robot."""
        return str(json.loads(self.ask("POST", "/maps/bench/branches", body))["token"])

    def folded(self) -> int:
        """Log entries so far."""
        info = MapInfo.model_validate_json(self.ask("GET", "/maps/bench"))
        return int(info.cursor.split(".")[1])

    def cpu_s(self) -> float:
        """Processor time so far, of the server and the processes beside it."""
        return cpu_s_of(self._pids())

    def resident_bytes(self) -> int:
        """Memory at its highest so far, of each of them; what they share counts for each."""
        found = [re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{pid}/status").read_text()) for pid in self._pids()]
        return sum(int(size[1]) * 1024 for size in found if size)

    def _pids(self) -> list[int]:
        return with_children(self.pid)

    def close(self) -> None:
        """Stop it."""
        self._process.terminate()
        self._process.wait(timeout=60)
        if self._process.stdout:
            self._process.stdout.close()


def with_children(pid: int) -> list[int]:
    """A process and those that it started."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [pid, *(int(child) for path in tasks for child in path.read_text().split())]


def cpu_s_of(pids: Iterable[int]) -> float:
    """Processor time of processes so far, with that of their children that ended."""
    stats = []
    for pid in pids:
        with suppress(FileNotFoundError):  # it ended meanwhile, and its parent counts it now
            stats.append(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split())
    return sum(sum(map(int, fields[11:15])) for fields in stats) / os.sysconf("SC_CLK_TCK")


@contextmanager
def served(geometry: Geometry) -> Iterator[Server]:
    """A server with an empty map, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder), geometry)
        try:
            yield server
        finally:
            server.close()


def bomb(commit: Commit) -> bytes:
    """A commit of eight cells, with an eighth of a gibibyte of zeros each, and heads that have room for them."""
    at = len(commit.data) - sum(4 + len(body) for body in commit.cells.values())
    head = decode_head(next(iter(commit.cells.values())))[1]
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(BOMB_BYTES // 8))
    streams = struct.pack("<BBII", 1, 1, BOMB_BYTES // 8, len(packed)) + packed
    room = struct.pack("<II", 8**7, 8**7)
    cells = [
        head[:12] + struct.pack("<iii", i, 0, 0) + room + b"" + head[32:33] + b"\x01" + head[34:] for i in range(8)
    ]
    parts = [struct.pack("<I", len(cell) + len(streams)) + cell + streams for cell in cells]
    return commit.data[: at - 4] + struct.pack("<I", len(cells)) + b"".join(parts)
