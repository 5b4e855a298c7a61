"""Run the map server.

    $ cairn serve --data ./cairn-data
    cairn map server on http://127.0.0.1:8750, data in cairn-data
    memory: at most 6319 MB in all: caches 1258, checks 2 x 1610, folding 403, decoding 268, bodies 268, programs 537
    cairn 0.1.0, settings: all defaults

Robots push their measurements to it and fetch what they miss; stop it with Ctrl-C or SIGTERM. Everything
that it acknowledged is in DIR/cairn.sqlite, so a crash or a power cut loses nothing.

Without a token it trusts every client that reaches it, and therefore only listens on this machine. To serve others,
put a secret of at least 16 characters into a file and name it with --admin-token-file; robots register with the
secret of --enrolment-token-file. CAIRN_ADMIN_TOKEN and CAIRN_ENROLMENT_TOKEN do the same from the environment.
`cairn token` gives tokens for less than everything. Beyond a network that you trust, use --tls-cert and --tls-key.
At SIGHUP it reads its certificate and the files of its tokens again; a file may have several, a line each.

    $ cat server.toml
    keep_evidence_s = 604_800
    quotas.bytes_per_day = 1_000_000_000
    $ cairn serve --data ./cairn-data --settings server.toml

A settings file holds what is the same at every start, and the settings that have no flag (listed below). In the
environment the same are CAIRN_KEEP_EVIDENCE_S and CAIRN_QUOTAS__BYTES_PER_DAY. A flag counts before the environment,
and the environment before the file.

A field server joins a base with --upstream http://BASE:PORT and a token of role relay, given by the base, in
--upstream-token-file or CAIRN_UPSTREAM_TOKEN: from then on both have the commits of all robots. For a retract by an
operator of one server to count on the other, each needs the other's key: --trust-server KEY (`cairn map ls --json`
shows it).

More commands look after the store (docs/administrator.md, docs/scale.md); each explains itself with --help:

    cairn serve backup --data DIR FILE      copy the store into one file, while the server runs
    cairn serve restore FILE --data DIR     make a folder out of such a file
    cairn serve check --data DIR            read everything and report what is damaged; --repair heals it
    cairn serve compact --data DIR          write a stopped server's store again, as small as it can be
    cairn serve archive MAP FILE --data DIR copy one map into a file, while the server runs
    cairn serve unarchive FILE --data DIR   bring it back into a stopped server's store
    cairn serve adopt --store --objects     make a restored database the owner of its bucket
"""

import ctypes
import errno
import gc
import logging
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI

from cairn_map.errors import BadInputError
from cairn_map.kernels.kernel_cache import keep_kernels
from cairn_server.access.server_certificate import certificate_of
from cairn_server.access.turns import Turns
from cairn_server.folding.fold_memory import FoldMemory
from cairn_server.folding.fold_process import fork_folding
from cairn_server.http.app import make_app
from cairn_server.http.middleware.deadlines import ListenerProtocol, protocol_of
from cairn_server.http.middleware.log_format import LogForm, start_logging
from cairn_server.http.middleware.secure_start import secured
from cairn_server.http.middleware.work_turns import Lanes
from cairn_server.http.routes.long_bodies import LongBodies, fork_long_bodies
from cairn_server.operations import check as check_command
from cairn_server.operations.backup import back_up_command, compact_command, restore_command
from cairn_server.operations.bucket_owner import adopt_command
from cairn_server.operations.life import Life
from cairn_server.operations.map_archive import archive_command, unarchive_command
from cairn_server.operations.reload import Reload
from cairn_server.operations.serve_options import serve_parser, settings_of
from cairn_server.operations.store_opening import opened, settling, store_of
from cairn_server.operations.upstream import joined
from cairn_server.operations.warm_start import WarmStart
from cairn_server.service import Service
from cairn_server.settings import LOOPBACK, Settings
from cairn_server.store.folder_lock import lock_folder, tell_port
from cairn_server.views.view_prefetch import ViewPrefetch

log = logging.getLogger(__name__)

BACKLOG = 128
GRACE_S = 6
"""Time for answers under way after the signal to stop; the fold under way and closing the store come after it."""
WEBSOCKETS: dict[str, Any] = {"ws": ListenerProtocol, "ws_max_size": 1 << 12, "ws_per_message_deflate": False}
"""WebSockets of listeners, who send next to nothing and must cost little."""
SWITCH_S = 0.0005
"""Longest time for which a thread that computes keeps the interpreter from another one that waits for it: a push needs
the interpreter some ten times on its way, and with Python's 5 ms would wait for the folding thread each time."""
FULL_SWEEPS_AFTER = 100
"""Sweeps of the middle generation after which all objects are looked at; 10 by default."""
ARENAS_MAX, MAPPED_FROM_BYTES = 2, 1 << 20
M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8
"""Parameters of glibc's `mallopt` (malloc.h)."""
OTHER_DESCRIPTORS = 300
"""Descriptors besides those of connections: three for each thread that reads the store, workers, exports, and the
connections that are accepted in one turn of the event loop before those that give way are closed."""
STRANGERS_SHARE = 4
KERNELS = "kernels"
"""Folder next to the store for compiled kernels, where those next to the code cannot be written; may be deleted."""
COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "backup": back_up_command,
    "restore": restore_command,
    "check": check_command.main,
    "adopt": adopt_command,
    "archive": archive_command,
    "compact": compact_command,
    "unarchive": unarchive_command,
}


def main(argv: list[str]) -> int:
    """Serve until stopped, or run one of the commands that look after the folder."""
    if argv and argv[0] in COMMANDS:
        return COMMANDS[argv[0]](argv[1:])
    args = serve_parser(__doc__).parse_args(argv)
    start_logging(LogForm(args.log_format), logging.INFO if args.verbose else logging.WARNING)
    settings = settings_of(args)
    # All that can be known to be wrong is, before a store is made.
    settings.check_reach()
    settings.check_store()
    settings.check_upstream()
    certificate = certificate_of(settings)
    settings = settings.model_copy(update={"limit_concurrency": connections_within(settings.limit_concurrency)})
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(
        signal.SIGHUP, signal.SIG_IGN
    )  # until there is something to reload; what is forked ignores it for good
    sys.setswitchinterval(SWITCH_S)
    keep_kernels(settings.folder / KERNELS)
    # Forked before there are threads: a lock that another thread held at the fork would stay locked in the child.
    open_store, reads_of = store_of(settings)
    folding = None
    if settings.folding == "here":
        folding = fork_folding(reads_of, FoldMemory.of_server(settings.memory, settings.folder))
    long_bodies = fork_long_bodies()
    keep_memory_small()
    with Life() as life, _folder_of(settings), listen(settings.host, settings.port) as listener:
        try:
            warm_start = WarmStart()
            service = Service(
                opened(open_store, settings),
                settings,
                certificate=certificate,
                fold_process=folding,
                warming=warm_start.complaint,
            )
            with closing(service), _views_of(service), settling(service), joined(service) as relay, warm_start:
                Reload(service, lambda: settings_of(args), relay).at_signal()
                _serve(service, listener, long_bodies, life)
        finally:
            long_bodies.close()
    return 0


def _folder_of(settings: Settings) -> AbstractContextManager[object]:
    """The folder of files on their way, which no other server has; SQLite's store takes it itself.

    Raises:
        ConflictError: kind `store_in_use`.
        BadInputError: kind `bad_store`: it cannot be made.
    """
    if settings.store is None:
        return nullcontext()
    try:
        settings.folder.mkdir(0o700, parents=True, exist_ok=True)
        return lock_folder(settings.folder)
    except OSError as exc:
        raise BadInputError("bad_store", f"cannot keep files in {settings.folder}: {exc.strerror}") from exc


def _views_of(service: Service) -> AbstractContextManager[object]:
    """Views made ahead, by a server that shows any."""
    if service.settings.folding == "only":
        return nullcontext()
    return closing(
        ViewPrefetch(
            service.store,
            service.views.cells.cache,
            service.fold_news,
            on_read=service.views.hot_spots.prepare,
        )
    )


def _serve(service: Service, listener: socket.socket, long_bodies: LongBodies, life: Life) -> None:
    app = make_app(service, long_bodies=long_bodies)
    config = config_of(app, service.settings)
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    scheme = "https" if service.certificate is not None else "http"
    if scheme == "http" and host not in LOOPBACK:
        log.warning("tokens and maps travel in the clear: give --tls-cert and --tls-key, or put a TLS proxy before it")
    tell_port(service.settings.folder, port)
    life.started(f"{scheme}://{shown}:{port}", service.settings)
    # A full sweep of the garbage collector takes 0.1 to 0.3 s, in which all wait. What is there by now stays, so none
    # looks at it; and what survived two sweeps of young objects is seldom a cycle.
    gc.freeze()
    gc.set_threshold(*gc.get_threshold()[:2], FULL_SWEEPS_AFTER)
    StoppableServer(config, app).run(sockets=[listener])


class StoppableServer(uvicorn.Server):
    """uvicorn's server, which at a signal says that it is not ready, and ends when proxies have noticed.

    A connection that a proxy keeps and this side closes loses the request that is on its way just then, and a push that
    meets a closed port may be answered 502: so all is answered until none is sent here any more.
    """

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._service: Service = app.state.service
        self._turns: tuple[Lanes, Turns] = app.state.lanes, app.state.reading
        self._stopped_by: int | None = None

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until stopped. A signal that comes before the loop runs ends it as one that comes later does.

        Raises:
            KeyboardInterrupt: it was stopped by a signal, which its text names.
        """
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, self.handle_exit) for number in numbers}
        try:
            super().run(sockets)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        if self._stopped_by is not None:
            raise KeyboardInterrupt(signal.Signals(self._stopped_by).name)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Say that the server stops, and stop it after a while, or at a second signal at once."""
        self._stopped_by = self._stopped_by or sig
        drain_s = self._service.settings.drain_s
        if drain_s and not self._service.readiness.is_closing:
            self._service.readiness.close()
            end = threading.Timer(drain_s, self._end, (sig, frame))
            end.daemon = True
            end.start()
        else:
            self._end(sig, frame)

    def _end(self, sig: int, frame: FrameType | None) -> None:
        """End live streams, which would not end alone or in time, then stop as uvicorn does."""
        self._service.stop_streams()
        super().handle_exit(sig, frame)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Answer what is at work, and refuse what waits for its turn."""
        for turns in self._turns:
            turns.close()
        await super().shutdown(sockets)


def config_of(app: FastAPI, settings: Settings, *, log_level: str = "warning") -> uvicorn.Config:
    """Configuration with which uvicorn serves the app."""
    places = app.state.places
    proxies = settings.trusted_proxies.split()
    config = uvicorn.Config(
        app,
        http=protocol_of(settings, places),
        proxy_headers=bool(proxies),
        forwarded_allow_ips=proxies,
        log_config=None,
        log_level=log_level,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        lifespan="off",
        **WEBSOCKETS,
    )
    config.load()
    certificate = app.state.service.certificate
    if certificate is not None:
        # Not by uvicorn: it would count a connection only after its handshake, and show one certificate for ever.
        config.http_protocol_class = secured(config.http_protocol_class, certificate, places, settings.head_s)  # type: ignore[assignment,arg-type]
    return config


def _stop(number: int, frame: FrameType | None) -> None:
    """End as Ctrl-C does, with everything closed; while requests are answered the signal is `StoppableServer`'s."""
    raise KeyboardInterrupt(signal.Signals(number).name)


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
        message = f"cannot listen on {host}:{port}: {exc.strerror}; {_way_out(exc, host)}"
        raise BadInputError("cannot_listen", message) from exc
    listener.listen(BACKLOG)
    return listener


def _way_out(exc: OSError, host: str) -> str:
    """Next step of an administrator whose server cannot listen."""
    if isinstance(exc, socket.gaierror) or exc.errno in (errno.EADDRNOTAVAIL, errno.EINVAL):
        return f"{host or 'an empty --host'} is no address of this machine: give one that it has, or 0.0.0.0 for all"
    if exc.errno == errno.EACCES:
        return "ports below 1024 are the system's: take another one, or give the server CAP_NET_BIND_SERVICE"
    return "another program does; stop it, or take another --port (0: any free one)"


def keep_memory_small() -> None:
    """Make glibc's allocator give freed memory back; to be called before there are threads.

    Each of the forty threads of the web server would get an arena of its own, where pieces of answers long sent lie
    between pieces of caches, and none can be given back; and each freed array of megabytes raises the size from which
    on memory comes from the system and returns to it. With two hundred robots on one map that was a third of all
    memory. Without glibc it does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, ARENAS_MAX)
        mallopt(M_MMAP_THRESHOLD, MAPPED_FROM_BYTES)


def connections_within(limit: int) -> int:
    """Most connections of holders of tokens, `limit` if there are descriptors for all; the soft limit is raised.

    Raises:
        BadInputError: kind `bad_setting`: there are too few for any.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = limit + limit // STRANGERS_SHARE + OTHER_DESCRIPTORS
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return limit
    most = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    if most == wanted:
        return limit
    fewer = (most - OTHER_DESCRIPTORS) * STRANGERS_SHARE // (STRANGERS_SHARE + 1)
    if fewer < 2:
        raise BadInputError(
            "bad_setting", f"{most} file descriptors are too few for a server; raise the limit (ulimit -n {wanted})"
        )
    log.warning(
        "limit_concurrency is %d, not %d: there are %d file descriptors (ulimit -n %d would do)",
        fewer,
        limit,
        most,
        wanted,
    )
    return fewer
