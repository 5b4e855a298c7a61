"""Pictures as a live stream that any browser shows: MJPEG over HTTP, from the standard library's server.

    GET /              a page with the stream in it
    GET /stream.mjpg   multipart/x-mixed-replace: each picture as it comes; who is slow misses some
    GET /view.jpg      the last picture

On loopback unless told otherwise; nobody is asked who he is, so beyond loopback everybody who gets through sees.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2

from cairn_map.arrays import Rgb
from cairn_map.errors import BadInputError

CLIENTS_MAX = 8
"""Streams at once; who comes then is told to come later."""
REQUESTS_MAX = 32
"""Connections at once; beyond that they are closed unread."""
TIMEOUT_S = 10.0
"""For a client to send its request, and to take a picture."""
JPEG_QUALITY = 85
BOUNDARY = "cairn-picture"
PAGE = b"""<!doctype html><html lang="en"><meta charset="utf-8"><title>cairn telepresence</title>
<style>html,body{margin:0;height:100%;background:#18191c}img{display:block;width:100%;height:100%;object-fit:contain}</style>
<img src="/stream.mjpg" alt="live view of the robot"></html>
"""


class Latest:
    """The last picture, as JPEG, for any number of readers."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jpeg = b""
        self._count = 0
        self._closed = False

    def show(self, picture: Rgb) -> None:
        """Replace the picture: (H, W, 3) uint8, R, G, B."""
        done, data = cv2.imencode(
            ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        )
        if not done:
            raise BadInputError("image_type", f"an image of shape {picture.shape} cannot be written as JPEG")
        with self._changed:
            self._jpeg, self._count = data.tobytes(), self._count + 1
            self._changed.notify_all()

    def close(self) -> None:
        """Let all readers come to an end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def jpeg(self) -> bytes:
        """The last picture; empty before the first."""
        return self._jpeg

    def after(self, count: int, *, timeout_s: float) -> tuple[int, bytes] | None:
        """The number of the last picture and the picture, once there is a newer one than `count`; None at the end.

        Raises:
            TimeoutError: nothing new came.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or self._count > count, timeout_s):
                raise TimeoutError
            return None if self._closed else (self._count, self._jpeg)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 16

    def __init__(self, address: tuple[str, int], latest: Latest, clients_max: int) -> None:
        super().__init__(address, _Handler)
        self.latest = latest
        self.streams = threading.BoundedSemaphore(clients_max)
        self.requests = threading.BoundedSemaphore(REQUESTS_MAX)

    def process_request(self, request: object, client_address: object) -> None:
        if not self.requests.acquire(blocking=False):
            self.shutdown_request(request)  # type: ignore[arg-type]
            return
        super().process_request(request, client_address)  # type: ignore[arg-type]

    def process_request_thread(self, request: object, client_address: object) -> None:
        try:
            super().process_request_thread(request, client_address)  # type: ignore[arg-type]
        finally:
            self.requests.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that went away is no event."""


class _Handler(BaseHTTPRequestHandler):
    timeout = TIMEOUT_S
    server_version = "cairn"
    sys_version = ""
    server: _Server  # type: ignore[assignment, unused-ignore]  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        """Answer."""
        path = self.path.partition("?")[0]
        if path == "/":
            self._send("text/html; charset=utf-8", PAGE)
        elif path == "/view.jpg":
            if self.server.latest.jpeg:
                self._send("image/jpeg", self.server.latest.jpeg)
            else:
                self.send_error(503, "no picture yet")
        elif path == "/stream.mjpg":
            self._stream()
        else:
            self.send_error(404, "there are /, /stream.mjpg and /view.jpg")

    def _send(self, kind: str, body: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def _stream(self) -> None:
        if not self.server.streams.acquire(blocking=False):
            self.send_error(503, "too many look already; come later")
            return
        try:
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            count = 0
            while (new := self._next(count)) is not None:
                count, jpeg = new
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
        finally:
            self.server.streams.release()

    def _next(self, count: int) -> tuple[int, bytes] | None:
        """The next picture; while none comes the last one again, by which a client that went away is noticed."""
        try:
            return self.server.latest.after(count, timeout_s=TIMEOUT_S)
        except TimeoutError:
            return count, self.server.latest.jpeg

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: an operator's terminal shows the command's own lines."""


@contextmanager
def streaming(
    latest: Latest, *, host: str = "127.0.0.1", port: int = 0, clients_max: int = CLIENTS_MAX
) -> Iterator[str]:
    """Serve a stream of pictures; gives its address.

    Args:
        latest: where the pictures come from.
        host: to listen on.
        port: 0 for any that is free.
        clients_max: streams at once.

    Raises:
        BadInputError: the address cannot be listened on.
    """
    try:
        server = _Server((host, port), latest, clients_max)
    except OSError as exc:
        raise BadInputError(
            "bad_address", f"cannot listen on {host}:{port}: {exc.strerror or exc}; choose another"
        ) from exc
    thread = threading.Thread(target=server.serve_forever, name="mjpeg", daemon=True)
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}/"
    finally:
        latest.close()
        server.shutdown()
        server.server_close()
        thread.join()
