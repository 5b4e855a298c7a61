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
from pathlib import Path
from typing import Self

from cryptography import x509

from cairn_map.errors import BadInputError
from cairn_map.wire.origins import origin_text
from cairn_server.settings import LOOPBACK, Settings

CERTIFICATES_BYTES_MAX = 1 << 20
"""Bytes of a file of certificates that are read: the first one, the server's own, is among them."""


@dataclass(frozen=True, slots=True)
class OwnNames:
    """Origins and hosts by which a server is known."""

    public: frozenset[str]
    """Origins that an administrator named."""
    certified: frozenset[str]
    """Hosts of the server's certificate; one with `*` is no server's own."""
    machine: frozenset[str]
    """Host name of the machine, with and without its domain."""

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Names by the settings.

        Raises:
            BadInputError: kind `bad_setting`: the certificate cannot be read.
        """
        name = socket.gethostname().lower()
        short = name.partition(".")[0]
        return cls(
            frozenset(settings.public_urls.split()),
            _certified_hosts(settings.tls_cert) if settings.tls_cert is not None else frozenset(),
            frozenset({name, short, f"{short}.local"} - {"", ".local"} - LOOPBACK),
        )

    def origins(self, scheme: str, address: tuple[str, int | None]) -> frozenset[str]:
        """Origins that a proof may name, which came to this address and port of the server."""
        if self.public:
            return self.public
        host, port = _plain_address(address[0]), address[1] or 0
        if self.certified and scheme == "https":
            hosts = self.certified
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


def _certified_hosts(path: Path) -> frozenset[str]:
    """Names and addresses for which the first certificate of a file stands, as a URL has them."""
    try:
        with path.open("rb") as file:
            certificate = x509.load_pem_x509_certificates(file.read(CERTIFICATES_BYTES_MAX))[0]
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return frozenset()
    except (OSError, ValueError) as exc:
        raise BadInputError("bad_setting", f"--tls-cert {path}: {exc}") from exc
    hosts = {name.lower() for name in names.get_values_for_type(x509.DNSName) if "*" not in name}
    return frozenset(hosts | {str(address) for address in names.get_values_for_type(x509.IPAddress)})
