"""git as a peer: the same commits as files of whole cells, over its own smart HTTP on loopback."""

import os
import shutil
import subprocess
import threading
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import zstandard
from tests.bench.peers import STREAM
from tests.links.proxy import FaultProxy

from cairn_map.codec.octree.cell_content import canonical_bytes
from cairn_map.codec.octree.cell_head import decode_head

REPACK = ("-a", "-d", "-q", "--depth=50", "--window=10")
"""As a server that is kept well does, after every push; deltas that were found stay."""


def missing() -> str:
    """Why it cannot be measured here; empty if it can."""
    return "" if shutil.which("git") else "no git"


class GitPeer:
    """A bare repository behind `git http-backend`, who pushes to it, and who fetches."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")} | {
            "GIT_CONFIG_NOSYSTEM": "1",
            "GIT_CONFIG_GLOBAL": os.devnull,
            "GIT_AUTHOR_NAME": "ant",
            "GIT_AUTHOR_EMAIL": "ant@localhost",
            "GIT_COMMITTER_NAME": "ant",
            "GIT_COMMITTER_EMAIL": "ant@localhost",
        }
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(folder, self._env))
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self._link = FaultProxy(self._server.server_address[1])
        self._url = f"http://127.0.0.1:{self._link.port}/map.git"
        self._git("init", "-q", "--bare", "-b", "main", "map.git")
        self._git("-C", "map.git", "config", "http.receivepack", "true")
        for clone in ("ant", "bee"):
            self._git("init", "-q", "-b", "main", clone)
            self._git("-C", clone, "remote", "add", "origin", self._url)

    def push(self, cells: Mapping[str, bytes]) -> None:
        """One commit of the one clone."""
        for name, data in cells.items():
            (self._folder / "ant" / name).write_bytes(data)
        for command in (("add", "-A"), ("commit", "-q", "-m", "one"), ("push", "-q", "origin", "main")):
            self._git("-C", "ant", *command)
        self._git("-C", "map.git", "repack", *REPACK)

    def fetched_bytes(self) -> int:
        """What the other clone's fetch takes on the wire, both ways."""
        before = self._link.size_bytes
        self._git("-C", "bee", "fetch", "-q", "origin", "main")
        return self._link.size_bytes - before

    def close(self) -> None:
        """Stop the server."""
        self._link.__exit__(None, None, None)
        self._server.shutdown()
        self._server.server_close()

    def _git(self, *arguments: str) -> None:
        subprocess.run(["git", *arguments], cwd=self._folder, env=self._env, check=True, capture_output=True)


def plain_file(cell: bytes) -> bytes:
    """A cell's canonical bytes, uncompressed, from its bytes in the fast profile."""
    _, head = decode_head(cell)
    raw: dict[int, bytes] = {}
    at = len(head)
    while at < len(cell):
        number, coding, raw_bytes, stored_bytes = STREAM.unpack_from(cell, at)
        body = cell[at + STREAM.size : at + STREAM.size + stored_bytes]
        raw[number] = zstandard.ZstdDecompressor().decompress(body, max_output_size=raw_bytes) if coding else body
        at += STREAM.size + stored_bytes
    return canonical_bytes(head, raw)


def _handler(folder: Path, env: Mapping[str, str]) -> type[BaseHTTPRequestHandler]:
    """`git http-backend` as the CGI program that it is."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._answer(b"")

        def do_POST(self) -> None:
            self._answer(self._body())

        def log_message(self, *arguments: object) -> None:
            pass

        def _body(self) -> bytes:
            if self.headers.get("Transfer-Encoding") != "chunked":
                return self.rfile.read(int(self.headers.get("Content-Length") or 0))
            body = b""
            while size := int(self.rfile.readline(), 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return body

        def _answer(self, body: bytes) -> None:
            path, _, query = self.path.partition("?")
            asked = {
                "GIT_PROJECT_ROOT": str(folder),
                "GIT_HTTP_EXPORT_ALL": "1",
                "PATH_INFO": path,
                "QUERY_STRING": query,
                "REQUEST_METHOD": self.command,
                "REMOTE_USER": "ant",
                "CONTENT_TYPE": self.headers.get("Content-Type", ""),
                "CONTENT_LENGTH": str(len(body)),
                "HTTP_CONTENT_ENCODING": self.headers.get("Content-Encoding", ""),
                "GIT_PROTOCOL": self.headers.get("Git-Protocol", ""),
            }
            backend = ["git", "http-backend"]
            done = subprocess.run(backend, input=body, env={**env, **asked}, stdout=subprocess.PIPE, check=True)
            head, _, content = done.stdout.partition(b"\r\n\r\n")
            fields = dict(line.split(": ", 1) for line in head.decode().split("\r\n"))
            self.send_response(int(fields.pop("Status", "200").split()[0]))
            for name, value in fields.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

    return Handler
