"""URLs of a robot's network: SCHEME://HOST:PORT, perhaps with ?domain=N, the ROS_DOMAIN_ID."""

from urllib.parse import SplitResult, parse_qsl, urlsplit

DOMAIN_MAX = 232
"""Largest ROS_DOMAIN_ID."""


def url_parts(url: str, scheme: str) -> SplitResult | None:
    """Parts of SCHEME://HOST:PORT, with a host and a port that there may be; None: it is none."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
        host.encode("idna")  # as the system's resolver will
    except ValueError:
        return None
    return parts if parts.scheme == scheme and host and port != 0 and "\0" not in host else None


def domain_of(query: str) -> int:
    """ROS_DOMAIN_ID of a URL's query, `domain=N`.

    Raises:
        ValueError: it says something else, or a number that is none.
    """
    fields = dict(parse_qsl(query, strict_parsing=True))
    text = fields.pop("domain", "")
    if fields or not (text.isascii() and text.isdigit() and int(text[:9]) <= DOMAIN_MAX):
        raise ValueError(f"{query!r:.100} is no domain=N")
    return int(text[:9])
