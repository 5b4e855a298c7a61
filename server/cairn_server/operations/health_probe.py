"""Probe for a container's health check: exit code 0 if the server of this machine answers, else 1 and the reason.

    $ python3 -m cairn_server.operations.health_probe /data

The port is the one that the server of this folder wrote down. The probe speaks http, or https if the server does, and
takes any certificate: all that it asks is whether the server is alive.
"""

import http.client
import ssl
import sys
from pathlib import Path

from cairn_server.store.folder_lock import told_port

TIMEOUT_S = 2.0


def why_not(port: int) -> str | None:
    """Reason why the server at a port of this machine counts as dead; None: it is alive."""
    secure = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    secure.check_hostname, secure.verify_mode = False, ssl.CERT_NONE
    said = ""
    for link in (
        http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S),
        http.client.HTTPSConnection("127.0.0.1", port, timeout=TIMEOUT_S, context=secure),
    ):
        try:
            link.request("GET", "/healthz")
            status = link.getresponse().status
        except (OSError, http.client.HTTPException) as exc:
            said = said or str(exc)
        else:
            return None if status == http.client.OK else f"/healthz says {status}"
        finally:
            link.close()
    return said


if __name__ == "__main__":
    PORT = told_port(Path(sys.argv[1]))
    sys.exit(f"no server wrote its port to {sys.argv[1]}" if PORT is None else why_not(PORT))
