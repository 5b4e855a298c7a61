"""A file of which only what was written last is kept: it is sent on as it is made."""

import io


class OneWay(io.RawIOBase):
    """What was written since it was last taken; has no way back, so that a zip is written in one go."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        """It is."""
        return True

    def write(self, data: object) -> int:
        """Add bytes."""
        part = bytes(data)  # type: ignore[call-overload]
        self._parts.append(part)
        return len(part)

    def taken(self) -> bytes:
        """What is there, and forget it."""
        data = b"".join(self._parts)
        self._parts.clear()
        return data
