"""File in memory that is sent on while it is written, so that only its last part is kept."""

import io


class ForwardOnlyFile(io.RawIOBase):
    """Write-only file that cannot seek; `taken` empties it. A zip archive in it is written in one pass."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        """True: the file is written only."""
        return True

    def write(self, data: object) -> int:
        """Add bytes."""
        part = bytes(data)  # type: ignore[call-overload]
        self._parts.append(part)
        return len(part)

    def taken(self) -> bytes:
        """Bytes written since the last call; they are removed from the file."""
        data = b"".join(self._parts)
        self._parts.clear()
        return data
