"""Doors of live robots, opened by their URLs; each needs a library that the others do without."""

from pathlib import Path

from cairn_client.live.live_source import LiveSource, bad_url
from cairn_map.errors import BadInputError


def open_door(url: str, *, ca_file: Path | None = None) -> LiveSource:
    """The source behind a URL, not yet connected.

    Args:
        url: see above.
        ca_file: issuer of the certificate of wss://, PEM; None: those that this machine trusts.

    Raises:
        BadInputError: kind `bad_url`: it is none; `missing_extra`: the door's library is not installed.
    """
    scheme = url.partition(":")[0]
    if ca_file is not None and scheme != "wss":
        raise BadInputError("bad_option", f"--ca is the issuer of a certificate of wss://, and {url!r:.100} has none")
    if scheme in ("ws", "wss"):
        from cairn_client.live.foxglove_source import FoxgloveSource

        return FoxgloveSource(url, ca_file=ca_file)
    if scheme == "zenoh":
        try:
            from cairn_client.live.zenoh_source import ZenohSource
        except ModuleNotFoundError as exc:
            raise BadInputError(
                "missing_extra", f'zenoh:// needs eclipse-zenoh: pip install "cairn-robotics[robot,live]" ({exc.name})'
            ) from exc
        return ZenohSource(url)
    if scheme == "ros2":
        from cairn_client.live.rclpy_source import RclpySource

        return RclpySource(url)
    raise bad_url(url)
