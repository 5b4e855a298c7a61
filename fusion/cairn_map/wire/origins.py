"""Origins of servers: scheme, host and port of a URL, as in RFC 6454, written `http://base:8750`."""

from urllib.parse import urlsplit

from cairn_map.errors import BadInputError

DEFAULT_PORTS = {"http": 80, "https": 443}


def origin_of(url: str) -> str:
    """Origin of a URL: `http://base:8750`, with the host in lower case and in ASCII, and the port in figures.

    Raises:
        BadInputError: kind `bad_url`.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        if host and not host.isascii():
            host = host.encode("idna").decode()  # a header carries ASCII only
    except ValueError:  # UnicodeError is one
        host = port = None
        parts = urlsplit("")
    if parts.scheme not in DEFAULT_PORTS or not host:
        raise BadInputError("bad_url", f"a server's URL is http://HOST:PORT, got {url[:200]!r}")
    return origin_text(parts.scheme, host, port or DEFAULT_PORTS[parts.scheme])


def origin_text(scheme: str, host: str, port: int) -> str:
    """Text of an origin; addresses of IPv6 stand in brackets."""
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
