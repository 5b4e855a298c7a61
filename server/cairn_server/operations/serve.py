"""Run the map server.

    $ cairn serve --data ./cairn-data
    cairn map server on http://127.0.0.1:8750, data in cairn-data

Robots push their measurements to it and fetch what they miss; stop it with Ctrl-C or SIGTERM. Everything
that it acknowledged is in DIR/cairn.sqlite, so a crash or a power cut loses nothing.

Without a token it trusts whoever reaches it, and therefore only listens on this machine. To serve others,
put a secret of at least 16 characters into a file and name it with --admin-token-file; robots register with
--enrolment-token-file's secret. CAIRN_ADMIN_TOKEN and CAIRN_ENROLMENT_TOKEN do the same from the environment.
`cairn token` gives tokens for less than everything. Beyond a network that you trust, use --tls-cert and --tls-key.

A field server is joined to a base with --upstream http://BASE:PORT and a token of role relay of the base's, in
--upstream-token-file or CAIRN_UPSTREAM_TOKEN: from then on both have every robot's commits. So that a retract by an
operator of one counts on the other, each is told the other's key: --trust-server KEY (`cairn map ls --json` shows it).

Three more commands look after the folder (docs/operations.md); each explains itself with --help:

    cairn serve backup --data DIR FILE      copy the store into one file, while the server runs
    cairn serve restore FILE --data DIR     make a folder out of such a file
    cairn serve check --data DIR            read everything and say what is damaged; --repair heals it
"""

import argparse
import logging
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from pydantic import ValidationError

from cairn_map.errors import BadInputError
from cairn_map.exit_codes import EXIT_CODES
from cairn_server.access.secret_file import secret_of
from cairn_server.folding.fold_process import fork_folding
from cairn_server.http.app import make_app
from cairn_server.http.middleware.deadlines import protocol_of
from cairn_server.http.middleware.log_format import LogForm, start_logging
from cairn_server.operations import backup as backup_command
from cairn_server.operations import check as check_command
from cairn_server.operations import restore as restore_command
from cairn_server.operations.allocator import keep_memory_small
from cairn_server.operations.upstream import UPSTREAM_VARIABLE, add_upstream_arguments, joined
from cairn_server.service import Service
from cairn_server.settings import LOOPBACK, Quotas, Settings
from cairn_server.store.folder_lock import tell_port
from cairn_server.store.sqlite.store import FILE_NAME, SqliteStore
from cairn_server.sync.checks.check_process import fork_checking
from cairn_server.views.views_ahead import ViewsAhead

log = logging.getLogger(__name__)

BACKLOG = 128
GRACE_S = 6
"""For answers under way, once the server is told to stop; the fold under way and closing the store come after it."""
MEGABYTE = 1 << 20
WEBSOCKETS: dict[str, Any] = {"ws": "websockets-sansio", "ws_max_size": 1 << 12, "ws_per_message_deflate": False}
"""Listeners send next to nothing, and must cost little."""
SWITCH_S = 0.0005
"""How soon a thread that computes lets another one have the interpreter: a push needs it some ten times on its way, and
would wait for the folder each time."""
COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "backup": backup_command.main,
    "restore": restore_command.main,
    "check": check_command.main,
}
FLAG_OF_SETTING = {
    "port": "--port",
    "admin_token": "--admin-token-file or CAIRN_ADMIN_TOKEN",
    "enrolment_token": "--enrolment-token-file or CAIRN_ENROLMENT_TOKEN",
    "stable_after_s": "--stable-after",
    "keep_evidence_s": "--keep-evidence",
    "branch_expiry_s": "--branch-expiry",
    "limit_concurrency": "--limit-concurrency",
    "body_bytes_per_s": "--min-rate",
    "disk_free_min_bytes": "--disk-free-min",
    "fold_lag_max_s": "--fold-lag-max",
    "trusted_servers": "--trust-server",
}
QUOTA_FLAGS = {
    "commits_per_minute": ("--quota-commits", "N", "commits that a robot may push in a minute"),
    "bytes_per_day": ("--quota-bytes", "BYTES", "bytes that a robot may push in a day (UTC)"),
    "cells_per_day": ("--quota-cells", "N", "cells that a robot's commits may touch in a day, together"),
    "cells_per_commit": ("--quota-commit-cells", "N", "cells that one commit may touch"),
    "map_extent_m": ("--map-extent", "METRES", "longest edge of the box of a map's cells"),
}


def main(argv: list[str]) -> int:
    """Run until stopped, or one of the commands beside that."""
    if argv and argv[0] in COMMANDS:
        return COMMANDS[argv[0]](argv[1:])
    settings = _settings(argv)
    settings.check_reach()
    settings.check_tls()
    signal.signal(signal.SIGTERM, _stop)
    sys.setswitchinterval(SWITCH_S)
    folding, checking = fork_folding(settings.folder / FILE_NAME), fork_checking()  # before there are threads
    keep_memory_small()
    with listen(settings.host, settings.port) as listener:
        try:
            service = Service(SqliteStore(settings.folder), settings, fold_process=folding, check_process=checking)
            with closing(service), closing(_views_ahead(service)), joined(service):
                _serve(service, listener)
        except KeyboardInterrupt:
            pass
    return 0


def _views_ahead(service: Service) -> ViewsAhead:
    settings = service.settings
    return ViewsAhead(service.store, service.cell_views, settings.folder, free_bytes_min=settings.disk_free_min_bytes)


def _serve(service: Service, listener: socket.socket) -> None:
    config = config_of(make_app(service), service.settings)
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    scheme = "https" if config.is_ssl else "http"
    if scheme == "http" and host not in LOOPBACK:
        log.warning("tokens and maps travel in the clear: give --tls-cert and --tls-key, or put a TLS proxy before it")
    tell_port(service.settings.folder, port)
    sys.stdout.write(f"cairn map server on {scheme}://{shown}:{port}, data in {service.settings.folder}\n")
    sys.stdout.flush()
    _Server(config, service).run(sockets=[listener])


class _Server(uvicorn.Server):
    """At a signal it is not ready any more, and live streams, which have no end of their own, are told."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """A signal to stop."""
        self._service.readiness.is_closing = True
        self._service.live.close()
        super().handle_exit(sig, frame)


def config_of(app: FastAPI, settings: Settings, *, log_level: str = "warning") -> uvicorn.Config:
    """How the HTTP library serves the app.

    Raises:
        BadInputError: kind `bad_setting`: no certificate, or not with this key.
    """
    config = uvicorn.Config(
        app,
        http=protocol_of(settings),
        log_config=None,
        log_level=log_level,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        lifespan="off",
        limit_concurrency=settings.limit_concurrency,
        ssl_certfile=settings.tls_cert,
        ssl_keyfile=settings.tls_key,
        **WEBSOCKETS,
    )
    try:
        config.load()
    except OSError as exc:  # ssl.SSLError is one
        raise BadInputError("bad_setting", f"--tls-cert {settings.tls_cert}, --tls-key: {exc}") from exc
    return config


def _stop(number: int, frame: FrameType | None) -> None:
    """After uvicorn finished its answers it raises the signal again; end as Ctrl-C does, with everything closed."""
    raise KeyboardInterrupt


def listen(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        BadInputError: kind `cannot_listen`.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Named as TCP so that asyncio turns Nagle off for it: else each small answer waits 40 ms for an acknowledgement.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as exc:
        listener.close()
        message = f"cannot listen on {host}:{port}: {exc.strerror}; another server may, try --port 0"
        raise BadInputError("cannot_listen", message) from exc
    listener.listen(BACKLOG)
    return listener


def _settings(argv: list[str]) -> Settings:
    defaults = Settings()
    parser = argparse.ArgumentParser(
        "cairn serve", description=__doc__, epilog=EXIT_CODES, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=defaults.folder, metavar="DIR", help="folder of the store")
    parser.add_argument("--host", default=defaults.host, help=f"address to listen on ({defaults.host})")
    parser.add_argument("--port", type=int, default=defaults.port, help=f"port, 0 for any free one ({defaults.port})")
    parser.add_argument("--admin-token-file", type=Path, metavar="FILE", help="its secret may do everything")
    parser.add_argument("--enrolment-token-file", type=Path, metavar="FILE", help="its secret may register robots")
    parser.add_argument(
        "--stable-after",
        type=float,
        default=defaults.stable_after_s,
        metavar="SECONDS",
        help="age at which a commit is in every backup, so that robots may drop it (86400)",
    )
    parser.add_argument(
        "--keep-evidence",
        type=float,
        default=defaults.keep_evidence_s,
        metavar="SECONDS",
        help="how long commits can be retracted without their robots' help; 0 stores only the last version (2592000)",
    )
    parser.add_argument(
        "--branch-expiry",
        type=float,
        metavar="SECONDS",
        help="end a robot's token when nobody showed it for so long; it registers again (never)",
    )
    parser.add_argument("--tls-cert", type=Path, metavar="FILE", help="certificate chain (PEM): speak https only")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="its private key (PEM)")
    parser.add_argument(
        "--limit-concurrency",
        type=int,
        default=defaults.limit_concurrency,
        metavar="N",
        help=f"connections served at once, more are answered 503 ({defaults.limit_concurrency})",
    )
    parser.add_argument(
        "--min-rate",
        type=float,
        default=defaults.body_bytes_per_s,
        metavar="BYTES",
        help="cut links that carry less than so many bytes a second, after half a minute (1000)",
    )
    parser.add_argument(
        "--disk-free-min",
        type=float,
        default=defaults.disk_free_min_bytes / MEGABYTE,
        metavar="MB",
        help="with less space than this, pushes get 507 and the server is not ready (64)",
    )
    parser.add_argument(
        "--fold-lag-max",
        type=float,
        default=defaults.fold_lag_max_s,
        metavar="SECONDS",
        help="while a commit waits longer to be folded, the server is not ready (600)",
    )
    parser.add_argument("--metrics-open", action="store_true", help="anybody may read /metrics, not only an admin")
    add_upstream_arguments(parser)
    forms = [str(form) for form in LogForm]
    parser.add_argument("--log-format", choices=forms, default=forms[0], help=f"how log lines look ({forms[0]})")
    parser.add_argument("-v", "--verbose", action="store_true", help="log every request and fold")
    for name, (flag, unit, text) in QUOTA_FLAGS.items():
        default = getattr(defaults.quotas, name)
        shown = "none" if default is None else f"{default:.0f}"
        parser.add_argument(
            flag, dest=name, type=float, metavar=unit, default=default, help=f"{text}; 0: any ({shown})"
        )
    args = parser.parse_args(argv)
    start_logging(LogForm(args.log_format), logging.INFO if args.verbose else logging.WARNING)
    try:
        return Settings(
            folder=args.data,
            host=args.host,
            port=args.port,
            admin_token=secret_of(args.admin_token_file, "CAIRN_ADMIN_TOKEN"),
            enrolment_token=secret_of(args.enrolment_token_file, "CAIRN_ENROLMENT_TOKEN"),
            stable_after_s=args.stable_after,
            keep_evidence_s=args.keep_evidence,
            branch_expiry_s=args.branch_expiry,
            quotas=Quotas.model_validate({name: getattr(args, name) or None for name in QUOTA_FLAGS}),
            tls_cert=args.tls_cert,
            tls_key=args.tls_key,
            limit_concurrency=args.limit_concurrency,
            body_bytes_per_s=args.min_rate,
            disk_free_min_bytes=_bytes_of(args.disk_free_min),
            fold_lag_max_s=args.fold_lag_max,
            metrics_open=args.metrics_open,
            upstream=args.upstream,
            upstream_token=secret_of(args.upstream_token_file, UPSTREAM_VARIABLE),
            trusted_servers=" ".join(args.trust_server),
        )
    except ValidationError as exc:
        first = exc.errors()[0]
        name = str(first["loc"][0])
        flag = QUOTA_FLAGS[name][0] if name in QUOTA_FLAGS else FLAG_OF_SETTING.get(name, name)
        raise BadInputError("bad_setting", f"{flag}: {first['msg']}") from exc


def _bytes_of(megabytes: float) -> int:
    if not 0 <= megabytes < 1 << 30:
        raise BadInputError("bad_setting", f"--disk-free-min is in megabytes, 0 or more, got {megabytes}")
    return int(megabytes * MEGABYTE)
