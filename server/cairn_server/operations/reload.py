"""Reload: at SIGHUP a server reads its certificate and its secrets again, without a stop.

    admin, enrolment and upstream token    of their files, and of the settings file
    certificate and key                    of the files that it was started with

What is not good changes nothing, and the log says why. Open connections go on: those of TLS with the certificate that
they began with, all others until they show a token that does not count any more. Everything else that a settings file
says counts from the next start on.
"""

import logging
import signal
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from types import FrameType

from cairn_map.errors import BadInputError, CairnError
from cairn_server.operations.serve_options import SECRETS
from cairn_server.operations.upstream import Relay
from cairn_server.service import Service
from cairn_server.settings import Settings

log = logging.getLogger(__name__)


class Reload:
    """Reload of one server; each signal is dealt with in a thread of its own, one after the other."""

    def __init__(self, service: Service, read_settings: Callable[[], Settings], relay: Relay | None) -> None:
        """Args: read_settings: as at the start, raises `CairnError`. relay: to the upstream server, if there is one."""
        self._service = service
        self._read_settings = read_settings
        self._relay = relay
        self._settings = service.settings
        self._lock = threading.Lock()

    def at_signal(self) -> None:
        """Reload at each SIGHUP from now on; by the main thread."""
        signal.signal(signal.SIGHUP, self._begin)

    def _begin(self, number: int, frame: FrameType | None) -> None:
        # Not in the handler itself, which may have interrupted the holder of the log's lock.
        threading.Thread(target=self.run, name="cairn-reload", daemon=True).start()

    def run(self) -> None:
        """Read again what may have changed."""
        with self._lock:
            changed: list[str] = []
            is_good = True
            for what, read_again in (
                ("tokens stay as they were", self._secrets),
                ("certificate stays as it was", self._certificate),
            ):
                try:
                    changed += read_again()
                except CairnError as exc:
                    log.error("reload: the %s: %s", what, exc.message)
                    is_good = False
            if changed:
                self._service.store.audit("reload", ", ".join(changed))
            elif is_good:
                log.warning("reload: nothing has changed")

    def _secrets(self) -> list[str]:
        """Names of the secrets that are others now."""
        new, old = self._read_settings(), self._settings
        new.check_reach()
        if (new.admin_token is None) != (old.admin_token is None):
            raise BadInputError(
                "bad_setting", "a server with tokens becomes one without, or the reverse, by a new start"
            )
        fields = [name for name in SECRETS if getattr(new, name) != getattr(old, name)]
        later = [name for name in Settings.model_fields if name not in SECRETS and _differ(new, old, name)]
        if later:
            log.warning("reload: these settings count from the next start on: %s", ", ".join(later))
        self._service.holders.use_secrets(new)
        if self._relay is not None:
            self._relay.use_token(new.upstream_token)
        self._settings = old.model_copy(update={name: getattr(new, name) for name in SECRETS})
        return [name.replace("_", " ") for name in fields]

    def _certificate(self) -> list[str]:
        """The certificate and its end, if it is another one now."""
        certificate = self._service.certificate
        if certificate is None:
            return []
        before = certificate.fingerprint
        certificate.reload()
        if certificate.fingerprint == before:
            return []
        return [f"certificate (until {datetime.fromtimestamp(certificate.ends_s, UTC):%Y-%m-%d %H:%M} UTC)"]


def _differ(new: Settings, old: Settings, name: str) -> bool:
    # The bound on connections is lowered at the start where there are few file descriptors.
    return name != "limit_concurrency" and getattr(new, name) != getattr(old, name)
