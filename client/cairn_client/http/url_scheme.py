"""Errors of links over TLS by their cause: a certificate that does not hold, or http and https taken for each other.

A server that speaks https alone drops a plain request without a word, so a client that was never answered looks whether
a handshake succeeds there: once for each failure, and never on a link that has worked.
"""

import socket
from urllib.parse import urlsplit

from cairn_map.errors import UnreachableError

PROBE_S = 3.0
"""Longest time of a handshake that only looks."""
NO_TLS = ("WRONG_VERSION_NUMBER", "UNKNOWN_PROTOCOL", "HTTP_REQUEST", "record layer failure", "PACKET_LENGTH_TOO_LONG")
"""Texts of OpenSSL about an answer that is none of TLS; which one comes depends on its version."""
CERTIFICATE_FAILED = "CERTIFICATE_VERIFY_FAILED"


def other_scheme(url: str) -> UnreachableError:
    """Error of a request by the wrong one of http and https."""
    scheme, rest = url.split(":", 1)
    right = "http" if scheme == "https" else "https"
    return UnreachableError("other_scheme", f"{url} answers, but speaks {right}, not {scheme}: write {right}:{rest}")


def unreachable(exc: Exception, url: str) -> UnreachableError:
    """Error of a request that failed by httpx's `TransportError`, by its cause."""
    known = _tls_error(url, str(exc))
    return known or UnreachableError(
        "no_link", f"cannot reach {url} ({exc or type(exc).__name__}); is `cairn serve` running?"
    )


def _tls_error(url: str, text: str) -> UnreachableError | None:
    """Error of a request over https, by OpenSSL's own text; None: it has another cause."""
    if CERTIFICATE_FAILED in text:
        why = "of an unknown issuer; name the issuer's file in SSL_CERT_FILE"
        if "has expired" in text:
            why = "that has ended; renew it there (and see whether this machine's clock is right)"
        elif "not yet valid" in text:
            why = "that is not valid yet; see whether this machine's clock is right"
        elif "mismatch" in text:
            why = "of another name or address; use the name that it is for"
        return UnreachableError("no_link", f"{url} shows a certificate {why}")
    if url.startswith("https:") and any(known in text for known in NO_TLS):
        return other_scheme(url)
    return None


def speaks_tls(url: str) -> bool:
    """True if a handshake succeeds at the host and port of a URL, whatever the certificate."""
    import ssl

    parts = urlsplit(url)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        plain = socket.create_connection((parts.hostname or "", parts.port or 80), timeout=PROBE_S)
        with plain, context.wrap_socket(plain, server_hostname=parts.hostname):
            return True
    except OSError:
        return False


def certificate_end_s(connection: object) -> float | None:
    """End of the certificate that a server showed on a connection, UTC seconds since 1970; None without TLS."""
    import ssl

    if not isinstance(connection, ssl.SSLSocket):
        return None
    ends = (connection.getpeercert() or {}).get("notAfter")
    return float(ssl.cert_time_to_seconds(ends)) if isinstance(ends, str) else None
