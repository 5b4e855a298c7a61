"""Server settings: each with its unit, bounds, default and meaning, said once.

The sentence below a field is also its help in `cairn serve --help`; the flags, the settings file and the environment
(`cairn_server.operations.serve_options`) take names, types and bounds from here.
"""

from ipaddress import ip_network
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit, urlunsplit

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from cairn_map.errors import BadInputError
from cairn_map.wire.origins import origin_of
from cairn_server.memory_shares import MemoryShares, memory_shares

LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


def _none_if_zero(value: Any) -> Any:
    return None if value in (0, "0") else value


def _networks(value: str) -> str:
    for part in value.split():
        ip_network(part)
    return value


def _database(value: str) -> str:
    if not value.startswith(("postgresql://", "postgres://")):
        raise ValueError("expected a URL like postgresql://USER@HOST/NAME; without one SQLite keeps the maps")
    return value


def _bucket(value: str) -> str:
    if not value.startswith("s3://") or not value.removeprefix("s3://").partition("/")[0]:
        raise ValueError("expected a URL like s3://BUCKET/PREFIX")
    return value.rstrip("/")


def _origins(value: str) -> str:
    try:
        return " ".join(origin_of(part) for part in value.split())
    except BadInputError as exc:
        raise ValueError(exc.message) from exc


Count = Annotated[Annotated[int, Field(ge=1)] | None, BeforeValidator(_none_if_zero)]
Metres = Annotated[Annotated[float, Field(gt=0)] | None, BeforeValidator(_none_if_zero)]
SECRET_LENGTH_MIN = 16
"""Characters that a secret has at least."""


def _secrets(value: str) -> str:
    secrets = value.split("\n")
    if not all(len(secret.strip()) >= SECRET_LENGTH_MIN for secret in secrets):
        raise ValueError(f"expected a secret of at least {SECRET_LENGTH_MIN} characters on each line")
    return "\n".join(secret.strip() for secret in secrets)


Secrets = Annotated[str, AfterValidator(_secrets)]
"""One secret, or several on lines of their own, all of which count: while one takes the place of another."""


class Quotas(BaseModel):
    """Bounds on what each robot may push to a map; None, or 0 in a settings file, is no bound. Admins have none."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    commits_per_minute: Count = 6000
    """Commits that a robot may push in a minute; a hundred a second lets one catch up that was offline for long."""
    bytes_per_day: Count = 128_000_000_000
    """Bytes that a robot may push in a day (UTC): a sweep of 64 beams to 80 m at 10 cm has 1.3 MB, one a second 112 GB.
    """
    cells_per_day: Count = 128_000_000
    """Cells that a robot's commits may touch in a day, together: such a sweep touches 1500 of 3.2 m."""
    bricks_per_day: Count = 16_000_000
    """Bricks of 8^3 voxels that a robot's commits may touch in a day beyond one for each of their bytes: work of all
    who merge them that nothing was sent for. Sweeps and images send 2.7 bytes and more for each brick."""
    registrations_per_hour: Count = 600
    """Robots that one enrolment token may register in an hour, all at once or one by one."""
    acts_per_hour: Count = 1000
    """Keys that one operator's token may admit in an hour, and retracts that it may make, together: each is a line of
    the audit log, of which the newest are kept."""
    cells_per_commit: Count = None
    """Cells that one commit may touch; FORMAT.md allows 4096 in any case."""
    map_extent_m: Metres = 100_000.0
    """Longest edge of the box of one robot's cells in a map, metres: a robot that lost its way must not put cells far
    away."""


class Settings(BaseModel):
    """Everything that can be set on a map server."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    folder: Path = Path("cairn-data")
    """Folder of the store, and of files on their way; made if missing."""
    store: Annotated[str, AfterValidator(_database)] | None = None
    """URL of a PostgreSQL database to keep the maps in, which any number of servers may share
    (postgresql://USER@HOST/NAME; its password in the file that PGPASSFILE names); default: SQLite in the folder."""
    objects: Annotated[str, AfterValidator(_bucket)] | None = None
    """URL of a bucket of an S3-compatible object store (s3://BUCKET/PREFIX), to which cells and evidence at rest move
    from a database; its key and address from AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, AWS_ENDPOINT_URL."""
    settle_cells_s: Annotated[float, Field(ge=0)] = 600.0
    """Seconds without a change after which cells move to the object store."""
    settle_evidence_s: Annotated[float, Field(ge=0)] = 86_400.0
    """Seconds after folding at which a commit's evidence moves to the object store."""
    objects_grace_s: Annotated[float, Field(ge=0)] = 86_400.0
    """Seconds for which an object that is out of use is kept: more than the longest answer takes, a standby lags, and
    the database may be set back by a restore (unless the bucket keeps versions for that long)."""
    database_bytes_max: Annotated[int, Field(ge=1 << 20)] | None = None
    """Room for the database, bytes, which it does not know itself: at 70 % of it a line is logged, from 95 % on pushes
    are answered 507. Default: pushes are refused once the database's disk is full."""
    folding: Literal["here", "elsewhere", "only"] = "here"
    """Server that brings what came into the maps of a shared store: here; elsewhere: another one; only: this process
    does nothing else, and answers probes and metrics alone."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8750
    """Port to listen on, 0 for any free one."""
    admin_token: Secrets | None = None
    """Secret whose bearer may do everything; without it any client is trusted, and only loopback is listened on. Of
    several, a line each, all count."""
    enrolment_token: Secrets | None = None
    """Secret whose bearer may register robots; without it only the admin token may. Of several, a line each, all
    count."""
    tls_cert: Path | None = None
    """Certificate chain, PEM: with it and its key the server speaks https only."""
    tls_key: Path | None = None
    """Private key of the certificate, PEM."""
    stable_after_s: Annotated[float, Field(ge=0)] = 86_400.0
    """Seconds after folding at which a commit is in every backup that may still be restored, so that robots may drop
    it."""
    keep_evidence_s: Annotated[float, Field(ge=0)] = 30 * 86_400.0
    """Seconds after folding for which a commit's evidence is kept, so that it can be retracted and differences be
    sent; 0 stores only the last version of the map."""
    branch_expiry_s: Annotated[float, Field(ge=60)] | None = None
    """Seconds without use after which a robot's token ends and the robot registers again; default: never."""
    metrics_open: bool = False
    """Any client may read /metrics, which names the maps; else admins only."""
    upstream: str | None = None
    """URL of a server to hold the same commits as (http://BASE:8750)"""
    upstream_token: str | None = None
    """Token of role relay, given by the upstream server."""
    upstream_maps_max: Annotated[int, Field(ge=0)] = 100
    """Maps on this server from which on none is made for the upstream server; admins create more."""
    trusted_servers: Annotated[str, Field(pattern=r"^([0-9a-f]{64}( [0-9a-f]{64})*)?$")] = ""
    """Public keys (hex, separated by spaces) of servers whose operators' retracts and prior data count here."""
    public_urls: Annotated[str, AfterValidator(_origins)] = ""
    """URLs under which robots ask this server (https://maps.example.org), separated by spaces, where a proxy or a name
    service gives it names of its own: robots prove their keys to these names only."""
    quotas: Quotas = Quotas()
    """Bounds on what each robot may push."""
    limit_concurrency: Annotated[int, Field(ge=2, le=100_000)] = 500
    """Connections of holders of tokens that are served at once, a sixteenth of them of one token (admins: all), and
    half of them live streams; strangers have a quarter as many places of their own."""
    trusted_proxies: Annotated[str, AfterValidator(_networks)] = ""
    """Addresses or networks of proxies, separated by spaces, whose `X-Forwarded-For` and `X-Forwarded-Proto` are
    believed; those of others are not."""
    head_s: Annotated[float, Field(gt=0)] = 15.0
    """Seconds from the connection, or from the answer before, until a request's head must be whole."""
    body_grace_s: Annotated[float, Field(gt=0)] = 30.0
    """Seconds that any body may take to come, and any answer to be taken."""
    body_bytes_per_s: Annotated[float, Field(gt=0)] = 1000.0
    """Slowest link that is not cut once the grace has passed, bytes a second."""
    drain_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """Seconds after the signal to stop for which all is still answered, while /healthz and /readyz say 503, so that a
    proxy that looks there sends the rest to other servers; a second signal ends it. With one server: 0."""
    disk_free_min_bytes: Annotated[int, Field(ge=0)] = 64 << 20
    """Free space on the store's disk below which pushes are answered 507 and the server is not ready; what was
    acknowledged is folded into it."""
    fold_lag_max_s: Annotated[float, Field(gt=0)] = 600.0
    """Seconds that a commit may wait to be folded while the server counts as ready."""
    memory_bytes: Annotated[int, Field(ge=1)] | None = None
    """Memory of all processes of the server together, bytes, divided among its parts as it says at the start. Default:
    a quarter of the memory of the machine, or of its container; at least 2.63 GB."""
    body_memory_bytes: Annotated[int, Field(ge=1 << 20)] | None = None
    """Memory for bodies of requests on their way, bytes; beyond it they are answered 503. One token may fill half; a
    commit has up to 2^26 bytes. Default: a share of memory_bytes, 2^28 from 5.4 GB on."""
    check_workers: Annotated[int, Field(ge=1)] | None = None
    """Processes that check expensive commits, started when the first one comes. Default: 2, or 1 if memory_bytes is
    small."""
    check_cpu_s: Annotated[float, Field(gt=0)] = 60.0
    """Processor time that the check of one commit may take, seconds; what its heads may claim takes some 20 s."""
    check_memory_bytes: Annotated[int, Field(ge=1 << 24)] | None = None
    """Memory that the check of one commit may take; a commit that needs more is refused. Default: a share of
    memory_bytes, 3 * 2^29 at most."""

    @property
    def memory(self) -> MemoryShares:
        """Memory of each part of the server.

        Raises:
            BadInputError: kind `bad_setting`: too little, or the parts that are set exceed it.
        """
        shares = memory_shares(self.memory_bytes)
        return shares.with_parts(
            bodies_bytes=self.body_memory_bytes, check_workers=self.check_workers, check_bytes=self.check_memory_bytes
        )

    @property
    def admin_tokens(self) -> list[str]:
        """Secrets whose bearer may do everything; empty: any client is trusted."""
        return self.admin_token.split("\n") if self.admin_token is not None else []

    @property
    def enrolment_tokens(self) -> list[str]:
        """Secrets whose bearer may register robots."""
        return self.enrolment_token.split("\n") if self.enrolment_token is not None else []

    @property
    def place(self) -> str:
        """Place of the maps, for people: without a password."""
        if self.store is None:
            return str(self.folder)
        found = urlsplit(self.store)
        return urlunsplit(found._replace(netloc=found.netloc.rpartition("@")[2], query=""))

    def check_store(self) -> None:
        """Refuse what is a database's where there is none: a role among other servers, an object store.

        Raises:
            BadInputError: kind `bad_setting`.
        """
        if self.folding != "here" and self.store is None:
            raise BadInputError(
                "bad_setting",
                "--no-fold and --fold-only are for servers that share a database (--store postgresql://...); SQLite is "
                "one process's",
            )
        if self.objects is not None and self.store is None:
            raise BadInputError(
                "bad_setting",
                "--objects is for servers that keep their maps in a database (--store postgresql://...); SQLite keeps "
                "everything in its folder",
            )

    def check_upstream(self) -> None:
        """Refuse an upstream server whose URL is none.

        Raises:
            BadInputError: kind `bad_url`.
        """
        if self.upstream is not None:
            origin_of(self.upstream)

    def check_tls(self) -> None:
        """Refuse a certificate without its key, and a key without its certificate.

        Raises:
            BadInputError: kind `bad_setting`.
        """
        if (self.tls_cert is None) != (self.tls_key is None):
            raise BadInputError("bad_setting", "TLS takes both a certificate (--tls-cert) and its key (--tls-key)")

    def check_reach(self) -> None:
        """Refuse to serve other machines without a token, and tokens that protect nothing.

        Raises:
            BadInputError: kind `open_server`: the host is not loopback and there is no admin token. Kind
                `weak_tokens`: an enrolment token without an admin token, or equal to it.
        """
        shared = set(self.admin_tokens) & set(self.enrolment_tokens)
        if shared or (self.enrolment_tokens and not self.admin_tokens):
            raise BadInputError(
                "weak_tokens",
                "an enrolment token needs a different admin token (--admin-token-file): without one any client may do "
                "everything, and with the same one every robot may",
            )
        if self.admin_token is None and self.host not in LOOPBACK:
            raise BadInputError(
                "open_server",
                f"without a token every client that reaches {self.host} could change the maps; "
                "give --admin-token-file, or listen on 127.0.0.1",
            )
