"""The server's certificate and its key, which may be replaced while connections are open.

A new pair of files takes the place of the old one as a whole: a context of TLS in which a certificate is loaded before
its key proves to be another one's would be of no use to anyone. Connections that are open keep the pair that they
began with.
"""

import logging
import ssl
import time
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes

from cairn_map.errors import BadInputError
from cairn_server.settings import Settings
from cairn_server.store.private_files import warn_if_open

log = logging.getLogger(__name__)

CERTIFICATES_BYTES_MAX = 1 << 20
"""Bytes of a file of certificates that are read."""


@dataclass(frozen=True, slots=True)
class LoadedCertificate:
    """A certificate as it was read from its file."""

    hosts: frozenset[str]
    """Names and addresses for which it stands, as a URL has them; one with `*` is no server's own."""
    ends_s: float
    """End of the first of its chain to end, UTC seconds since 1970."""
    fingerprint: bytes
    """SHA-256 of the certificate itself."""


class ServerCertificate:
    """Certificate that the server shows from now on; usable from any thread."""

    def __init__(self, cert: Path, key: Path) -> None:
        """Read both files.

        Raises:
            BadInputError: kind `bad_setting`: one of them is none, or they do not belong together.
        """
        self._cert, self._key = cert, key
        self._now = self._loaded()

    @property
    def context(self) -> ssl.SSLContext:
        """Context for the next connection."""
        return self._now[0]

    @property
    def hosts(self) -> frozenset[str]:
        """Names and addresses for which it stands."""
        return self._now[1].hosts

    @property
    def ends_s(self) -> float:
        """End of it, UTC seconds since 1970."""
        return self._now[1].ends_s

    @property
    def fingerprint(self) -> bytes:
        """SHA-256 of it."""
        return self._now[1].fingerprint

    def reload(self) -> None:
        """Read both files again; the present pair stays if they are not good.

        Raises:
            BadInputError: as at first.
        """
        self._now = self._loaded()

    def _loaded(self) -> tuple[ssl.SSLContext, LoadedCertificate]:
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            context.load_cert_chain(self._cert, self._key)
            warn_if_open(self._key)
        except OSError as exc:  # ssl.SSLError is one
            raise BadInputError("bad_setting", f"--tls-cert {self._cert}, --tls-key {self._key}: {exc}") from exc
        found = read_certificate(self._cert)
        if found.ends_s <= time.time():
            log.warning("the certificate %s has ended: clients that check it do not connect", self._cert)
        return context, found


def certificate_of(settings: Settings) -> ServerCertificate | None:
    """The certificate that the settings name; None: the server speaks plain HTTP.

    Raises:
        BadInputError: kind `bad_setting`.
    """
    settings.check_tls()
    if settings.tls_cert is None or settings.tls_key is None:
        return None
    return ServerCertificate(settings.tls_cert, settings.tls_key)


def read_certificate(path: Path) -> LoadedCertificate:
    """Names and end of the certificate in a file.

    Raises:
        BadInputError: kind `bad_setting`.
    """
    try:
        with path.open("rb") as file:
            chain = x509.load_pem_x509_certificates(file.read(CERTIFICATES_BYTES_MAX))
    except (OSError, ValueError) as exc:
        raise BadInputError("bad_setting", f"--tls-cert {path}: {exc}") from exc
    ends_s = min(certificate.not_valid_after_utc.timestamp() for certificate in chain)
    return LoadedCertificate(_hosts_of(chain[0]), ends_s, chain[0].fingerprint(hashes.SHA256()))


def _hosts_of(certificate: x509.Certificate) -> frozenset[str]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return frozenset()
    hosts = {name.lower() for name in names.get_values_for_type(x509.DNSName) if "*" not in name}
    return frozenset(hosts | {str(address) for address in names.get_values_for_type(x509.IPAddress)})
