"""Names of this server: the origins under which robots ask it, so that a proof for another server opens none.

    --public-url given      these, and no others
    its own certificate     https, the certificate's names and addresses, the port of the connection
    else                    the address and port that the connection came to, and this machine's host name there

Without the setting a proxy's name is unknown, and so is a name that only a name service has: such a proof is refused,
with the setting as next step. `Host` says nothing here, since a server that hands a proof on writes it freely.
"""

import socket
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Self

from cairn_map.wire.origins import origin_text
from cairn_server.access.server_certificate import ServerCertificate
from cairn_server.settings import LOOPBACK, Settings


@dataclass(frozen=True, slots=True)
class OwnNames:
    """Origins and hosts by which a server is known."""

    public: frozenset[str]
    """Origins that an administrator named."""
    certificate: ServerCertificate | None
    """The server's certificate, whose hosts are those of the moment; None: it has none."""
    machine: frozenset[str]
    """Host name of the machine, with and without its domain."""

    @classmethod
    def of(cls, settings: Settings, certificate: ServerCertificate | None = None) -> Self:
        """Names by the settings, and by the certificate that the server shows."""
        name = socket.gethostname().lower()
        short = name.partition(".")[0]
        return cls(
            frozenset(settings.public_urls.split()),
            certificate,
            frozenset({name, short, f"{short}.local"} - {"", ".local"} - LOOPBACK),
        )

    def origins(self, scheme: str, address: tuple[str, int | None]) -> frozenset[str]:
        """Origins that a proof may name, which came to this address and port of the server."""
        if self.public:
            return self.public
        host, port = _plain_address(address[0]), address[1] or 0
        certified = self.certificate.hosts if self.certificate is not None else frozenset[str]()
        if certified and scheme == "https":
            hosts = certified
        elif host in LOOPBACK:
            hosts = self.machine | LOOPBACK
        else:
            hosts = self.machine | {host}
        return frozenset(origin_text(scheme, each, port) for each in hosts)


def _plain_address(host: str) -> str:
    """Address without the clothing that IPv6 gives to one of IPv4; a name as it is."""
    try:
        address = ip_address(host)
    except ValueError:
        return host
    mapped = address.ipv4_mapped if address.version == 6 else None
    return str(mapped or address)
