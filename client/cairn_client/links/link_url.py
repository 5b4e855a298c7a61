"""URLs of a robot's network: SCHEME://HOST:PORT, perhaps with ?domain=N, the ROS_DOMAIN_ID."""

import re
from urllib.parse import SplitResult, parse_qsl, urlsplit

DOMAIN_MAX = 232
"""Largest ROS_DOMAIN_ID."""
DOMAIN = re.compile(r"0*[0-9]{1,3}")


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
        ValueError: it says something else, says it twice, or a number that is none.
    """
    match parse_qsl(query, strict_parsing=True):
        case [("domain", text)] if DOMAIN.fullmatch(text) and int(text) <= DOMAIN_MAX:
            return int(text)
    raise ValueError(f"{query!r:.100} is no domain=N")
