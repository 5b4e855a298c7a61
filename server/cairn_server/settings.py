"""The server's settings, all in one place, each with its unit and meaning."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.errors import BadInputError

LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


Count = Annotated[int, Field(ge=1)]


class Quotas(BaseModel):
    """How much each robot may push to a map; None: as much as it likes. Administrators may everything."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    commits_per_minute: Count | None = 6000
    """A hundred a second: a robot that was offline for long may catch up."""
    bytes_per_day: Count | None = 64_000_000_000
    cells_per_day: Count | None = 4_000_000
    cells_per_commit: Count | None = None
    """FORMAT.md allows 4096 in any case."""
    map_extent_m: Annotated[float, Field(gt=0)] | None = 100_000.0
    """Longest edge of the box of all cells of a map: a robot that lost its way must not put cells far away."""


class Settings(BaseModel):
    """What `cairn serve` can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: Path = Path("cairn-data")
    """Where the store is; made if missing."""
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8750
    """0: any free one."""
    admin_token: Annotated[str, Field(min_length=16)] | None = None
    """Who has it may do everything. Without it the server trusts everybody, and so only listens on loopback."""
    enrolment_token: Annotated[str, Field(min_length=16)] | None = None
    """Who has it may register robots; without it only the admin token may."""
    stable_after_s: Annotated[float, Field(ge=0)] = 86_400.0
    """A commit folded longer ago is in every backup that may still be restored, so robots may drop it."""
    branch_expiry_s: Annotated[float, Field(ge=60)] | None = None
    """A robot's token ends when nobody showed it for so long; None: never. The robot registers again."""
    quotas: Quotas = Quotas()
    tls_cert: Path | None = None
    """Certificate chain, PEM; with it (and `tls_key`) the server speaks https only."""
    tls_key: Path | None = None
    """Its private key, PEM."""
    limit_concurrency: Annotated[int, Field(ge=2, le=100_000)] = 500
    """Connections that are served at once; some more are answered 503."""
    head_s: Annotated[float, Field(gt=0)] = 15.0
    """A request's head must have come so soon after the connection, or after the answer before."""
    body_grace_s: Annotated[float, Field(gt=0)] = 30.0
    """So long a body may take, and an answer to be taken, and"""
    body_bytes_per_s: Annotated[float, Field(gt=0)] = 1000.0
    """beyond it no slower than this."""

    def check_tls(self) -> None:
        """Refuse half of what TLS needs.

        Raises:
            BadInputError: kind `bad_setting`.
        """
        if (self.tls_cert is None) != (self.tls_key is None):
            raise BadInputError("bad_setting", "TLS takes both a certificate (--tls-cert) and its key (--tls-key)")

    keep_evidence_s: Annotated[float, Field(ge=0)] = 30 * 86_400.0
    """How long after it was folded a commit's evidence is kept, so that it can be retracted, and differences be sent;
    0: only the last version of the map is stored."""
    disk_free_min_bytes: Annotated[int, Field(ge=0)] = 64 << 20
    """With less than this free on the store's disk, pushes are refused (507), and the server is not ready. What was
    acknowledged is folded into the rest."""
    fold_lag_max_s: Annotated[float, Field(gt=0)] = 600.0
    """While a commit waits longer to be folded, the server is not ready."""
    metrics_open: bool = False
    """Whether anybody may read `/metrics`, which names the maps; else an admin only."""
    upstream: str | None = None
    """URL of the server that this one is joined to: both then hold the same commits."""
    upstream_token: str | None = None
    """Of role relay, given by that server."""
    trusted_servers: Annotated[str, Field(pattern=r"^([0-9a-f]{64}( [0-9a-f]{64})*)?$")] = ""
    """Public keys of servers whose operators' retracts and prior data count here, in hex, separated by spaces."""
    check_workers: Annotated[int, Field(ge=1)] = 2
    """Processes that check dear commits, made when the first one comes."""
    check_cpu_s: Annotated[float, Field(gt=0)] = 60.0
    """Processor time that one commit may take there; what its heads may claim takes some 20 s at most."""
    check_memory_bytes: Annotated[int, Field(ge=1 << 24)] = 3 << 29
    """Memory that it may take there; 2^29 bytes of evidence need twice their size."""

    def check_reach(self) -> None:
        """Refuse to serve strangers without a token, and tokens that protect nothing.

        Raises:
            BadInputError: the host is not loopback and there is no admin token; or an enrolment token without an admin
                token, or equal to it.
        """
        if self.enrolment_token is not None and self.admin_token in (None, self.enrolment_token):
            raise BadInputError(
                "weak_tokens",
                "an enrolment token needs another admin token beside it (--admin-token-file): without one everybody "
                "may do everything, and with the same one every robot may",
            )
        if self.admin_token is None and self.host not in LOOPBACK:
            raise BadInputError(
                "open_server",
                f"without a token everybody who reaches {self.host} could change the maps; "
                "give --admin-token-file, or listen on 127.0.0.1",
            )
