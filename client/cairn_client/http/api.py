"""The server's routes as functions; the only file that knows HTTP.

Errors come out as the same `CairnError` that the server raised. What could not be asked at all, or should be asked
again later, is `UnreachableError`. Every call is idempotent, so whoever calls may simply call again.
httpx is loaded with the first `MapApi`: it is a seventh of the import of a robot, by processor time (tests/bench).
"""

from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pydantic import TypeAdapter, ValidationError

from cairn_client.http.certificates import certificates
from cairn_client.http.open_sockets import OpenSockets
from cairn_client.sync.requests import Box, GetUpload, PutPart
from cairn_client.sync.responses import Answer, FetchedCell, Traffic, error_of, list_of, unreachable
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector, vector_digest, version_vector_from_json
from cairn_map.errors import BadInputError, DamagedDataError
from cairn_map.evidence.fingerprint import fingerprint_from_hex
from cairn_map.evidence.grid import Cell
from cairn_map.wire.access_messages import CreateToken, NewSecret, TokenInfo
from cairn_map.wire.frames import Frame
from cairn_map.wire.messages import (
    INDEX_PAGE,
    BranchInfo,
    CellIndex,
    CreateMap,
    LogEntry,
    MapInfo,
    MissingRequest,
    Pushed,
    Register,
    Registered,
    Retract,
    Retracted,
    RobotStatus,
    Upload,
    VectorJson,
    message_from_json,
)
from cairn_map.wire.resumed_replies import Replies

if TYPE_CHECKING:
    import httpx

PROTOCOL_VERSION = "1"
TIMEOUT_S, CONNECT_S = 30.0, 5.0
NO_CONTENT, NOT_MODIFIED = 204, 304
ANSWER_BYTES_MAX = 64 << 20
"""Longest JSON answer that is read."""
ERROR_BYTES_MAX = 1 << 16
VECTOR: TypeAdapter[VectorJson] = TypeAdapter(VectorJson)


class MapApi:
    """One server's routes; `server_url` such as `http://base:8750`.

    Of https the certificate must be signed by `ca_file` (PEM), else by SSL_CERT_FILE, else by who is known everywhere.
    """

    def __init__(self, server_url: str, *, token: str | None = None, ca_file: Path | None = None) -> None:
        self.traffic = Traffic()
        self.sockets = OpenSockets()
        self._vector = EMPTY
        """The last one that came whole: many cells come with the same."""
        if not server_url.startswith(("http://", "https://")) or "/maps/" in server_url:
            raise BadInputError("bad_url", f"a server's URL is http://HOST:PORT, got {server_url!r}")
        import httpx

        timeout = httpx.Timeout(TIMEOUT_S, connect=CONNECT_S)
        try:
            options: Any = {"timeout": timeout, "event_hooks": {"request": [self.sockets.watch]}}
            self._client = httpx.Client(base_url=server_url.rstrip("/"), verify=certificates(ca_file), **options)
        except httpx.InvalidURL as exc:
            raise BadInputError("bad_url", f"{server_url!r} is not a URL: {exc}") from exc
        self._client.headers.clear()  # a robot that asks whether anything is new pays for each of them
        self.token = token

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def create_map(self, name: str, request: CreateMap) -> MapInfo:
        """Create a map, or find the equal one."""
        return message_from_json(MapInfo, self._ask("PUT", f"/maps/{name}", content=request.model_dump_json().encode()))

    def maps(self) -> list[MapInfo]:
        """All maps."""
        return list_of(MapInfo, self._ask("GET", "/maps"))

    def map_info(self, name: str) -> MapInfo:
        """One map."""
        return message_from_json(MapInfo, self._ask("GET", f"/maps/{name}"))

    def register(self, name: str, request: Register) -> Registered:
        """Register a robot; later calls use the token that comes back."""
        body = self._ask("POST", f"/maps/{name}/branches", content=request.model_dump_json().encode())
        registered = message_from_json(Registered, body)
        self.token = registered.token
        return registered

    def branches(self, name: str) -> list[BranchInfo]:
        """All robots of a map."""
        return list_of(BranchInfo, self._ask("GET", f"/maps/{name}/branches"))

    def put_status(self, name: str, branch: str, status: RobotStatus) -> None:
        """Tell where a robot is and how it is doing."""
        self._ask("PUT", f"/maps/{name}/branches/{branch}/status", content=status.model_dump_json().encode())

    def put_view(self, name: str, branch: str, picture: bytes) -> None:
        """Show what a robot sees: JPEG or PNG."""
        self._ask("PUT", f"/maps/{name}/branches/{branch}/view", content=picture)

    def view(self, name: str, branch: str) -> bytes:
        """A robot's latest picture."""
        return self._ask("GET", f"/maps/{name}/branches/{branch}/view")

    def deregister(self, name: str, branch: str) -> None:
        """Deregister a robot."""
        self._ask("DELETE", f"/maps/{name}/branches/{branch}")

    def push(self, name: str, commit: Commit, *, seal: str | None = None, signatures: str | None = None) -> Pushed:
        """Push a commit; when this returns, the server has it for good. `seal`: of a retract that is the server's."""
        headers = {key: text for key, text in (("Cairn-Seal", seal), ("Cairn-Signature", signatures)) if text}
        path = f"/maps/{name}/commits/{commit.id}"
        return message_from_json(Pushed, self._ask("PUT", path, content=commit.data, headers=headers))

    def upload(self, name: str, ask: GetUpload | PutPart) -> Upload:
        """How much of a commit's bytes came in parts, after this one if it is one; with the last it is pushed."""
        path, params = f"/maps/{name}/commits/{ask.id}/upload", {"digest": ask.digest}
        if isinstance(ask, GetUpload):
            return message_from_json(Upload, self._ask("GET", path, params=params))
        params |= {"total": f"{ask.total_bytes}", "offset": f"{ask.offset_bytes}"}
        headers = {"Cairn-Signature": ask.signatures} if ask.signatures else {}
        return message_from_json(Upload, self._ask("PATCH", path, content=ask.data, params=params, headers=headers))

    def commit(self, name: str, commit: CommitId) -> tuple[bytes, str | None]:
        """A commit's bytes as they were pushed, and the seal on a retract that is the server's."""
        answer = self._send("GET", f"/maps/{name}/commits/{commit}")
        return answer.body, answer.headers.get("Cairn-Seal")

    def retract(self, name: str, request: Retract) -> Retracted:
        """Undo commits exactly."""
        body = self._ask("POST", f"/maps/{name}/retracts", content=request.model_dump_json().encode())
        return message_from_json(Retracted, body)

    def create_token(self, token: str, request: CreateToken) -> NewSecret:
        """Create a token; its secret is shown this once."""
        body = self._ask("PUT", f"/tokens/{token}", content=request.model_dump_json().encode())
        return message_from_json(NewSecret, body)

    def rotate_token(self, token: str) -> NewSecret:
        """Another secret for a token."""
        return message_from_json(NewSecret, self._ask("POST", f"/tokens/{token}/rotate"))

    def revoke_token(self, token: str) -> None:
        """End a token."""
        self._ask("DELETE", f"/tokens/{token}")

    def tokens(self) -> list[TokenInfo]:
        """All tokens, without their secrets."""
        return list_of(TokenInfo, self._ask("GET", "/tokens"))

    def log(self, name: str, *, after: int = 0, limit: int = 100) -> list[LogEntry]:
        """Log entries after a sequence number, oldest first."""
        return list_of(LogEntry, self._ask("GET", f"/maps/{name}/log", params={"after": after, "limit": limit}))

    def cell_index(
        self, name: str, author: Author | None = None, *, box: Box | None = None, after: Cell | None = None
    ) -> CellIndex:
        """A page of the cells of a map, or of a box (lowest and highest cell); all: `cell_index.whole_index`."""
        asked = {"author": author, "box": f"{box[0]},{box[1]}" if box else None, "after": after}
        params = {"limit": str(INDEX_PAGE), "hottest": "true"} | {
            key: str(value) for key, value in asked.items() if value is not None
        }
        index = message_from_json(CellIndex, self._ask("GET", f"/maps/{name}/main/cells", params=params))
        self._vector = index.header.coverage
        return index

    def vector_at(self, name: str, cursor: str) -> VersionVector:
        """The ids that a server had folded at a cursor."""
        body = self._ask("GET", f"/maps/{name}/main/vector", params={"at": cursor})
        return version_vector_from_json(VECTOR.validate_json(body))

    def cell(self, name: str, cell: Cell, *, etag: str | None = None) -> FetchedCell:
        """One cell's octree, unless it is the one with this ETag."""
        headers = {"If-None-Match": etag} if etag else {}
        answer = self._send("GET", f"/maps/{name}/main/cells/{cell}", headers=headers)
        try:
            return FetchedCell(
                body=None if answer.status == NOT_MODIFIED else answer.body,
                etag=answer.headers["ETag"],
                cursor=cursor_from_text(answer.headers["Cairn-Cursor"]),
                coverage=self._coverage(name, answer.headers),
                fingerprint=fingerprint_from_hex(answer.headers["Cairn-Fingerprint"]),
            )
        except (KeyError, ValidationError) as exc:
            raise DamagedDataError("bad_message", f"the answer for cell {cell} lacks its headers: {exc}") from exc

    def put_cell(self, name: str, cell: Cell, data: bytes) -> None:
        """Put a damaged cell right; a sound one stays as it is, and of other bytes nothing is taken."""
        headers = {"Content-Type": "application/vnd.cairn.cell"}
        self._ask("PUT", f"/maps/{name}/main/cells/{cell}", content=data, headers=headers)

    def missing(
        self, name: str, branch: str, request: MissingRequest, *, replies: Replies | None = None
    ) -> Generator[Frame, None, None]:
        """Frames as they arrive; with `replies`, nothing that came with an earlier reply comes again.

        Raises:
            UnreachableError: the link broke; the frames before it were whole and may be kept.
            DamagedDataError: the bytes are not frames.
        """
        reply = (replies or Replies()).reply_to(request)
        body = reply.request.model_dump_json(exclude_defaults=True).encode()
        with self._open("POST", f"/maps/{name}/branches/{branch}/missing", content=body) as response:
            known = response.status_code == NO_CONTENT
            yield from reply.again() if known else reply.frames(self.traffic.counted(response.iter_bytes()))

    def stream(self, path: str, *, headers: Mapping[str, str] | None = None) -> Generator[bytes, None, None]:
        """The parts of an answer that goes on as long as there is news, such as `/maps/{map}/events`."""
        with self._open("GET", path, headers=headers) as response:
            yield from response.iter_bytes()

    def probe(self, path: str) -> Answer:
        """Any answer that is no error, to see what is at the other end."""
        return self._send("GET", path)

    def _coverage(self, name: str, headers: Mapping[str, str]) -> VersionVector:
        """The version vector that a cell came with: as it is, or by a digest, of the one known last or asked for."""
        if "Cairn-Coverage" in headers:
            return version_vector_from_json(VECTOR.validate_json(headers["Cairn-Coverage"]))
        digest = headers["Cairn-Coverage-Digest"]
        if vector_digest(self._vector) != digest:
            self._vector = self.vector_at(name, headers["Cairn-Cursor"])
        if vector_digest(self._vector) != digest:
            raise DamagedDataError("bad_message", "the server's version vector does not have the digest that it states")
        return self._vector

    def _ask(self, method: str, path: str, **options: Any) -> bytes:
        return self._send(method, path, **options).body

    def _send(self, method: str, path: str, **options: Any) -> Answer:
        """A whole answer, but never a longer one than a cell may have."""
        body = bytearray()
        with self._open(method, path, **options) as response:
            for part in response.iter_bytes():
                self.traffic.down_bytes += len(part)
                body += part
                if len(body) > ANSWER_BYTES_MAX:
                    raise BadInputError("too_large", f"the server's answer is longer than {ANSWER_BYTES_MAX} bytes")
            return Answer(response.status_code, response.headers, bytes(body))

    @contextmanager
    def _open(
        self,
        method: str,
        path: str,
        *,
        content: bytes = b"",
        headers: Mapping[str, str] | None = None,
        params: Mapping[str, str | int] | None = None,
    ) -> "Iterator[httpx.Response]":
        """An answer that begins well and is still to be read; an error of the server or the link as ours."""
        import httpx

        sent = {"Cairn-Protocol": PROTOCOL_VERSION, **(headers or {})}
        if self.token:
            sent["Authorization"] = f"Bearer {self.token}"
        if content:
            is_json = content.startswith(b"{") and method != "PATCH"
            sent.setdefault("Content-Type", "application/json" if is_json else "application/vnd.cairn.commit")
        try:
            with self._client.stream(method, path, headers=sent, content=content, params=params) as response:
                self.traffic.up_bytes += len(content)
                if not response.is_success and response.status_code != NOT_MODIFIED:
                    body = next(response.iter_bytes(ERROR_BYTES_MAX), b"")
                    raise error_of(response.status_code, response.headers.get("Retry-After", ""), body)
                yield response
        except httpx.TransportError as exc:
            raise unreachable(exc) from exc
        except httpx.DecodingError as exc:
            raise DamagedDataError("bad_message", f"the server's answer cannot be decompressed: {exc}") from exc
