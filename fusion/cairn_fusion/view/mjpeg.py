"""The last of a run of pictures as JPEG, and the parts of an MJPEG stream made of them; `mjpeg_server` serves both."""

import threading
from collections.abc import Iterator

import cv2

from cairn_map.arrays import Rgb
from cairn_map.errors import BadInputError

REPEAT_S = 10.0
"""Time without a new picture after which the last one is sent again: a client that went away is noticed by it."""
JPEG_QUALITY = 85
BOUNDARY = "cairn-picture"
"""Separator of the parts of a stream."""


class Latest:
    """The last picture, as JPEG, for any number of readers on threads of their own."""

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

    def parts(self) -> Iterator[bytes]:
        """Parts of a multipart body, one a picture as it comes, until `close`; a slow reader misses some."""
        count = 0
        while (new := self._after(count)) is not None:
            count, jpeg = new
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            yield head.encode() + jpeg + b"\r\n"

    def _after(self, count: int) -> tuple[int, bytes] | None:
        """Number and bytes of the last picture, once newer than `count` or after `REPEAT_S`; None when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._count > count, REPEAT_S)
            return None if self._closed else (self._count, self._jpeg)
