"""API of a map server: its routes as functions, over HTTP.

Errors come out as the same `CairnError` that the server raised. What could not be asked at all, or should be asked
again later, is `UnreachableError`. Every call is idempotent, so a caller may simply call again.
httpx is loaded with the first `MapApi`: it is a seventh of the import of a robot, by processor time (tests/bench).
"""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pydantic import TypeAdapter, ValidationError

from cairn_client.http.answer_reading import CODING, body_of_error, header_text, parts_of, sent_again, time_sample
from cairn_client.http.open_sockets import OpenSockets
from cairn_client.http.origin_tokens import without_token
from cairn_client.http.request_deadline import PACE, Pace, RequestDeadline
from cairn_client.http.url_scheme import other_scheme, speaks_tls, unreachable
from cairn_client.sync.requests import Box, GetUpload, PutPart
from cairn_client.sync.responses import (
    Answer,
    FetchedCell,
    TimeSample,
    Traffic,
    error_of,
    list_of,
    narrower,
)
from cairn_map.commits.attachment import Attachment
from cairn_map.commits.commit import Commit
from cairn_map.commits.cursor import cursor_from_text
from cairn_map.commits.ids import Author, CommitId
from cairn_map.commits.version_vector import EMPTY, VersionVector, vector_digest, version_vector_from_json
from cairn_map.errors import BadInputError, CairnError, DamagedDataError, NotFoundError, first_error
from cairn_map.evidence.fingerprint import fingerprint_from_hex
from cairn_map.evidence.grid import Cell
from cairn_map.machine_clocks import MACHINE_CLOCKS
from cairn_map.wire.access_messages import (
    AuditEntry,
    Challenge,
    CreateToken,
    NewSecret,
    RobotClosed,
    RobotKeyList,
    RobotUse,
    SiteInfo,
    TokenInfo,
)
from cairn_map.wire.change_messages import ChangesAnswer
from cairn_map.wire.frames import FRAME_BYTES_MAX, JSON_BYTES_MAX, Frame
from cairn_map.wire.hot_spot_messages import HotSpotsAnswer
from cairn_map.wire.hottest_messages import HottestAnswer
from cairn_map.wire.layer_messages import KINDS_FORMAT, AddLayer, Assignment, LayerAdded, LayerInfo, RobotAssignment
from cairn_map.wire.mark_messages import AttachmentState, MarkPage, MarkReceipt, MarkRequest, WantedAttachments
from cairn_map.wire.messages import (
    INDEX_PAGE,
    BranchInfo,
    CellIndex,
    CreateMap,
    LogEntry,
    MapDeleted,
    MapInfo,
    MapSizes,
    MissingRequest,
    PushReceipt,
    Register,
    Registered,
    ReplyHeader,
    Retract,
    Retracted,
    RobotStatus,
    Upload,
    VectorJson,
    check_json_size,
    message_from_json,
)
from cairn_map.wire.origins import origin_of
from cairn_map.wire.resumed_replies import Replies

if TYPE_CHECKING:
    import ssl

    import httpx

PROTOCOL_VERSION = "1"
FORMAT_VERSION = str(KINDS_FORMAT)
"""Newest version of cells and commits that is read; without it a server takes a client for one of version 1."""
TIMEOUT_S, CONNECT_S = 30.0, 5.0
NO_CONTENT, NOT_MODIFIED = 204, 304
CACHED = ("GET", "HEAD")
"""Methods whose answers may come from a cache, and say a time of long ago."""
ANSWER_BYTES_MAX = 64 << 20
"""Longest whole answer that is read."""
REPLY_BYTES_MAX = (1 << 26) + FRAME_BYTES_MAX + JSON_BYTES_MAX
"""Longest reply to `missing`: PROTOCOL.md 6, and its header."""
VECTOR: TypeAdapter[VectorJson] = TypeAdapter(VectorJson)


def certificates(ca_file: Path | None) -> "ssl.SSLContext | bool":
    """Those of a file (PEM), or True: those that are known everywhere.

    Raises:
        BadInputError: kind `bad_setting`: it is no such file.
    """
    import ssl

    try:
        return ssl.create_default_context(cafile=ca_file) if ca_file else True
    except OSError as exc:  # ssl.SSLError is one
        raise BadInputError("bad_setting", f"{ca_file} is no file of certificates: {exc}") from exc


class MapApi:
    """One server's routes; `server_url` such as `http://base:8750`.

    Of https the certificate must be signed by `ca_file` (PEM), else by SSL_CERT_FILE, else by a public issuer.
    """

    def __init__(
        self,
        server_url: str,
        *,
        token: str | None = None,
        ca_file: Path | None = None,
        pace: Pace = PACE,
        steady_s: Callable[[], float] = MACHINE_CLOCKS.steady_s,
    ) -> None:
        self._pace = pace
        self._steady_s = steady_s
        self._time: TimeSample | None = None
        """The best that the server's answers said of its time since that was taken."""
        self.traffic = Traffic()
        self.sockets = OpenSockets()
        self._was_answered = False
        self._vector = EMPTY
        """The version vector that came whole last: many cells come with the same one."""
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
        self.origin = origin_of(server_url)
        """Origin of the server, the only one that the token is sent to: redirects are not followed."""
        self.use_token(token)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def use_token(self, token: str | None) -> None:
        """Send this token with each request from here on; None: no token.

        Raises:
            BadInputError: kind `bad_header`: no token has such characters.
        """
        self.token = header_text(token, "a token") if token else None

    def take_time(self) -> TimeSample | None:
        """The server's time in the quickest of its answers since the last call; None if none said it."""
        taken, self._time = self._time, None
        return taken

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def create_map(self, name: str, request: CreateMap) -> MapInfo:
        """Create a map, or find the equal one."""
        return message_from_json(MapInfo, self._ask("PUT", f"/maps/{name}", content=request.model_dump_json().encode()))

    def map_sizes(self, name: str) -> MapSizes:
        """Bytes of a map on its server, by what they are for."""
        return message_from_json(MapSizes, self._ask("GET", f"/maps/{name}/sizes"))

    def delete_map(self, name: str) -> MapDeleted:
        """Delete a map for good."""
        return message_from_json(MapDeleted, self._ask("DELETE", f"/maps/{name}", params={"confirm": name}))

    def maps(self) -> list[MapInfo]:
        """All maps."""
        return list_of(MapInfo, self._ask("GET", "/maps"))

    def site(self) -> SiteInfo:
        """Servers of the store of the server that answers."""
        return message_from_json(SiteInfo, self._ask("GET", "/servers"))

    def map_info(self, name: str) -> MapInfo:
        """One map."""
        return message_from_json(MapInfo, self._ask("GET", f"/maps/{name}"))

    def register(self, name: str, request: Register, *, proof: str | None = None) -> Registered:
        """Register a robot; later calls use the token that comes back. `proof`: text of a `KeyProof`."""
        headers = {"Cairn-Proof": proof} if proof else {}
        body = self._ask("POST", f"/maps/{name}/branches", content=request.model_dump_json().encode(), headers=headers)
        registered = message_from_json(Registered, body)
        self.use_token(registered.token)
        return registered

    def challenge(self) -> str:
        """A text for a robot's keys to sign; good for a minute. No token is sent."""
        token, self.token = self.token, None
        try:
            return message_from_json(Challenge, self._ask("GET", "/challenge")).challenge
        finally:
            self.token = token

    def keys(self, name: str) -> RobotKeyList:
        """Keys that a map's robots are bound to, and the robots that were refused for theirs."""
        return message_from_json(RobotKeyList, self._ask("GET", f"/maps/{name}/keys"))

    def admit(self, name: str, author: Author) -> None:
        """Admit a robot's other key, by an operator's word."""
        self._ask("PUT", f"/maps/{name}/keys/{author}")

    def branches(self, name: str) -> list[BranchInfo]:
        """All robots of a map."""
        return list_of(BranchInfo, self._ask("GET", f"/maps/{name}/branches"))

    def put_status(self, name: str, branch: str, status: RobotStatus) -> None:
        """Put a robot's status report."""
        self._ask("PUT", f"/maps/{name}/branches/{branch}/status", content=status.model_dump_json().encode())

    def put_view(self, name: str, branch: str, picture: bytes) -> None:
        """Put a picture of a robot's view: JPEG or PNG."""
        self._ask("PUT", f"/maps/{name}/branches/{branch}/view", content=picture)

    def view(self, name: str, branch: str) -> bytes:
        """A robot's latest picture."""
        return self._ask("GET", f"/maps/{name}/branches/{branch}/view")

    def deregister(self, name: str, branch: str) -> None:
        """Deregister a robot."""
        self._ask("DELETE", f"/maps/{name}/branches/{branch}")

    def robot_uses(self, name: str) -> list[RobotUse]:
        """Use of their shares of a map's bounds by all robots."""
        return list_of(RobotUse, self._ask("GET", f"/maps/{name}/robots"))

    def close_robot(self, name: str, robot: str) -> RobotClosed:
        """Close all incarnations of a robot: they take no new commits, and its shares are whole again."""
        return message_from_json(RobotClosed, self._ask("POST", f"/maps/{name}/robots/{robot}/close"))

    def push(self, name: str, commit: Commit, *, seal: str | None = None, signatures: str | None = None) -> PushReceipt:
        """Push a commit; when this returns, the server has it for good. `seal`: of a retract that is the server's."""
        headers = {key: text for key, text in (("Cairn-Seal", seal), ("Cairn-Signature", signatures)) if text}
        path = f"/maps/{name}/commits/{commit.id}"
        receipt = message_from_json(PushReceipt, self._ask("PUT", path, content=commit.data, headers=headers))
        if receipt.id != str(commit.id):
            raise DamagedDataError("bad_message", f"the server acknowledges {receipt.id}, not {commit.id}")
        return receipt

    def upload(self, name: str, ask: GetUpload | PutPart) -> Upload:
        """Progress of a commit that goes in parts, after this part if it is one; with the last part it is pushed."""
        path, params = f"/maps/{name}/commits/{ask.id}/upload", {"digest": ask.digest}
        if isinstance(ask, GetUpload):
            return message_from_json(Upload, self._ask("GET", path, params=params))
        params |= {"total": f"{ask.total_bytes}", "offset": f"{ask.offset_bytes}"}
        headers = {"Cairn-Signature": ask.signatures} if ask.signatures else {}
        return message_from_json(Upload, self._ask("PATCH", path, content=ask.data, params=params, headers=headers))

    def commit(self, name: str, commit: CommitId) -> tuple[bytes, str | None]:
        """A commit's bytes as they were pushed, and the seal on a retract that is the server's."""
        answer = self._send("GET", f"/maps/{name}/commits/{commit}")
        is_sealed = "Cairn-Seal" in answer.headers
        return answer.body, sent_again(answer.headers, "Cairn-Seal") if is_sealed else None

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

    def confirm_token(self, token: str) -> TokenInfo:
        """Let a token count again that a restore brought back."""
        return message_from_json(TokenInfo, self._ask("POST", f"/tokens/{token}/confirm"))

    def tokens(self) -> list[TokenInfo]:
        """All tokens, without their secrets."""
        return list_of(TokenInfo, self._ask("GET", "/tokens"))

    def audit(self, **choice: str | int) -> list[AuditEntry]:
        """Lines of the audit log, newest first: those that fit a choice (`map`, `since`, `who`, ... of PROTOCOL.md)."""
        return list_of(AuditEntry, self._ask("GET", "/audit", params={"newest": "true", **choice}))

    def log(self, name: str, *, after: int = 0, limit: int = 100) -> list[LogEntry]:
        """Log entries after a sequence number, oldest first."""
        return list_of(LogEntry, self._ask("GET", f"/maps/{name}/log", params={"after": after, "limit": limit}))

    def cell_index(
        self,
        name: str,
        author: Author | None = None,
        *,
        box: Box | None = None,
        after: Cell | None = None,
        held: ReplyHeader | None = None,
    ) -> CellIndex:
        """A page of the cells of a map, or of a box (lowest and highest cell); all: `cell_index.whole_index`.

        What the header held says of the commits in the map does not come again.
        """
        since = held.to if held else None
        asked = {"author": author, "box": f"{box[0]},{box[1]}" if box else None, "after": after, "since": since}
        params = {"limit": str(INDEX_PAGE), "hottest": "true"} | {
            key: str(value) for key, value in asked.items() if value is not None
        }
        found = message_from_json(CellIndex, self._ask("GET", f"/maps/{name}/main/cells", params=params))
        index = found.model_copy(update={"header": found.header.whole(held, since=since)})
        self._vector = index.header.coverage
        return index

    def changes(
        self, name: str, *, since_s: float | None, until_s: float | None = None, box_m: Sequence[float] | None = None
    ) -> ChangesAnswer:
        """Changes of a map between two times of capture; a box is x0, y0, z0, x1, y1, z1 in metres."""
        asked = {"since": since_s, "until": until_s, "box": ",".join(map(str, box_m)) if box_m else None}
        params = {key: str(value) for key, value in asked.items() if value is not None}
        return message_from_json(ChangesAnswer, self._ask("GET", f"/maps/{name}/main/changes", params=params))

    def hottest(self, name: str, *, count: int, box_m: Sequence[float] | None = None) -> HottestAnswer:
        """The occupied voxels of the highest temperature; a box is x0, y0, z0, x1, y1, z1 in metres."""
        params = {"count": str(count)} | ({"box": ",".join(map(str, box_m))} if box_m else {})
        return message_from_json(HottestAnswer, self._ask("GET", f"/maps/{name}/main/hottest", params=params))

    def hot_spots(
        self, name: str, *, over_k: float, min_voxels: int, count: int, box_m: Sequence[float] | None = None
    ) -> HotSpotsAnswer:
        """The first `count` hot spots of a map, or of a box in metres; asked again until it is `complete`."""
        params = {"over_k": repr(over_k), "min_voxels": str(min_voxels), "count": str(count)}
        params |= {"box": ",".join(map(str, box_m))} if box_m else {}
        return message_from_json(HotSpotsAnswer, self._ask("GET", f"/maps/{name}/main/hotspots", params=params))

    def marks(self, name: str, *, box_m: Sequence[float] | None = None, after: str | None = None) -> MarkPage:
        """A page of the marks of a map, or of a box in metres; all: `mark_pages.mark_pages`."""
        asked = {"box": ",".join(map(str, box_m)) if box_m else None, "after": after}
        params = {key: value for key, value in asked.items() if value is not None}
        return message_from_json(MarkPage, self._ask("GET", f"/maps/{name}/main/marks", params=params))

    def put_mark(self, name: str, request: MarkRequest) -> MarkReceipt:
        """Add, change or remove a mark, as an operator."""
        body = self._ask("POST", f"/maps/{name}/main/marks", content=request.model_dump_json().encode())
        return message_from_json(MarkReceipt, body)

    def layers(self, name: str) -> list[LayerInfo]:
        """The layers of a map: the one that it began with, then the others by name."""
        return list_of(LayerInfo, self._ask("GET", f"/maps/{name}/layers"))

    def add_layer(self, name: str, request: AddLayer) -> LayerAdded:
        """Add a layer to a map, as an operator; an equal one stays as it is."""
        body = self._ask("POST", f"/maps/{name}/layers", content=request.model_dump_json().encode())
        return message_from_json(LayerAdded, body)

    def assignment(self, name: str, robot: str) -> Assignment | None:
        """Layers that operators assigned to a robot; None: none, or the server is of an earlier version."""
        try:
            found = list_of(RobotAssignment, self._ask("GET", f"/maps/{name}/assignments", params={"robot": robot}))
        except NotFoundError as exc:
            if exc.kind != "no_route":
                raise
            return None
        return next((each.assignment for each in found if each.robot == robot), None)

    def assignments(self, name: str) -> list[RobotAssignment]:
        """Layers that operators assigned to robots, by robot."""
        return list_of(RobotAssignment, self._ask("GET", f"/maps/{name}/assignments"))

    def assign(self, name: str, robot: str, assignment: Assignment) -> None:
        """Assign layers to a robot, as an operator."""
        self._ask("PUT", f"/maps/{name}/assignments/{robot}", content=assignment.model_dump_json().encode())

    def unassign(self, name: str, robot: str) -> None:
        """Leave a robot's layers to its program again, as an operator."""
        self._ask("DELETE", f"/maps/{name}/assignments/{robot}")

    def wanted_attachments(self, name: str, *, robot: str | None = None) -> WantedAttachments:
        """Attachments of marks that the server lacks: all, or those that a robot may have."""
        params = {} if robot is None else {"robot": robot}
        return message_from_json(WantedAttachments, self._ask("GET", f"/maps/{name}/main/attachments", params=params))

    def attachment(self, name: str, sha256: str) -> bytes:
        """Bytes of an attachment; `attachment_copy` compares their SHA-256."""
        return self._ask("GET", f"/maps/{name}/main/attachments/{sha256}")

    def put_attachment_part(self, name: str, attached: Attachment, data: bytes, *, offset: int) -> AttachmentState:
        """Send a part of an attachment."""
        path, params = f"/maps/{name}/main/attachments/{attached.sha256}", {"total": f"{attached.size_bytes}"}
        body = self._ask("PATCH", path, content=data, params=params | {"offset": f"{offset}"})
        return message_from_json(AttachmentState, body)

    def vector_at(self, name: str, cursor: str) -> VersionVector:
        """The ids that a server had folded at a cursor."""
        body = self._ask("GET", f"/maps/{name}/main/vector", params={"at": cursor})
        return _vector_of(body)

    def cell(self, name: str, cell: Cell, *, etag: str | None = None) -> FetchedCell:
        """One cell's octree, unless it is the one with this ETag."""
        headers = {"If-None-Match": etag} if etag else {}
        answer = self._send("GET", f"/maps/{name}/main/cells/{cell}", headers=headers)
        try:
            return FetchedCell(
                body=None if answer.status == NOT_MODIFIED else answer.body,
                etag=sent_again(answer.headers, "ETag"),
                cursor=cursor_from_text(answer.headers["Cairn-Cursor"]),
                coverage=self._coverage(name, answer.headers),
                fingerprint=fingerprint_from_hex(answer.headers["Cairn-Fingerprint"]),
            )
        except KeyError as exc:
            raise DamagedDataError("bad_message", f"the answer for cell {cell} lacks its header {exc}") from exc

    def cell_view(self, name: str, cell: Cell) -> bytes:
        """View of one cell's voxels, known ones, with log-odds: how it reads now."""
        return self._ask("GET", f"/maps/{name}/main/cells/{cell}.view", params={"known": "true"})

    def put_cell(self, name: str, cell: Cell, data: bytes) -> None:
        """Put a damaged cell right; a sound one stays as it is, and of other bytes nothing is taken."""
        headers = {"Content-Type": "application/vnd.cairn.cell"}
        self._ask("PUT", f"/maps/{name}/main/cells/{cell}", content=data, headers=headers)

    def missing(
        self,
        name: str,
        branch: str,
        request: MissingRequest,
        *,
        replies: Replies | None = None,
        has_epochs: bool = True,
    ) -> Generator[Frame, None, None]:
        """Frames as they arrive; with `replies`, nothing that came with an earlier reply comes again.

        Without epochs, nothing has to be said of the version of cells that is read.

        Raises:
            UnreachableError: the link broke; the frames before it were whole and may be kept.
            DamagedDataError: the bytes are not frames.
        """
        reply = (replies or Replies()).reply_to(request)
        body = reply.request.model_dump_json(exclude_defaults=True).encode()
        path, headers = f"/maps/{name}/branches/{branch}/missing", {} if has_epochs else {"Cairn-Format": ""}
        with self._open("POST", path, content=body, headers=headers) as (response, deadline):
            known = response.status_code == NO_CONTENT
            parts = parts_of(response, self.traffic, at_most_bytes=REPLY_BYTES_MAX, deadline=deadline)
            yield from reply.again() if known else reply.frames(parts)

    def stream(
        self, path: str, *, headers: Mapping[str, str] | None = None, at_most_bytes: int | None = None
    ) -> Generator[bytes, None, None]:
        """The parts of a long answer; None: it goes on as long as there is news, such as `/maps/{map}/events`."""
        with self._open("GET", path, headers=headers) as (response, deadline):
            yield from parts_of(response, self.traffic, at_most_bytes=at_most_bytes, deadline=deadline)

    def probe(self, path: str) -> Answer:
        """Any answer that is no error, to see what is at the other end."""
        return self._send("GET", path)

    def _coverage(self, name: str, headers: Mapping[str, str]) -> VersionVector:
        """Version vector of a cell's answer: as it is, or named by its digest, then known or requested."""
        if "Cairn-Coverage" in headers:
            return _vector_of(headers["Cairn-Coverage"])
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
        with self._open(method, path, **options) as (response, deadline):
            for part in parts_of(response, self.traffic, at_most_bytes=ANSWER_BYTES_MAX, deadline=deadline):
                body += part
            return Answer(response.status_code, response.headers, bytes(body))

    @property
    def _shown_url(self) -> str:
        """The server's URL in messages."""
        return str(self._client.base_url.copy_with(path="/"))

    def _is_for_tls(self) -> bool:
        """True if this client speaks http where https is spoken."""
        return self.origin.startswith("http:") and speaks_tls(self.origin)

    def _lacks_token(self, error: CairnError) -> bool:
        """True if the server wants a token, and this client has none for it."""
        return self.token is None and error.kind == "no_token"

    @contextmanager
    def _open(
        self,
        method: str,
        path: str,
        *,
        content: bytes = b"",
        headers: Mapping[str, str] | None = None,
        params: Mapping[str, str | int] | None = None,
    ) -> "Iterator[tuple[httpx.Response, RequestDeadline]]":
        """Context of an answer that began well and is still to be read; errors come out as a `CairnError`."""
        import httpx

        sent = {"Cairn-Protocol": PROTOCOL_VERSION, "Cairn-Format": FORMAT_VERSION, "Accept-Encoding": CODING}
        sent |= headers or {}
        sent = {field: text for field, text in sent.items() if text}
        if self.token:
            sent["Authorization"] = f"Bearer {self.token}"
        if content:
            is_json = content.startswith(b"{") and method != "PATCH"
            sent.setdefault("Content-Type", "application/json" if is_json else "application/vnd.cairn.commit")
        for field, text in sent.items():
            header_text(text, field)
        deadline = RequestDeadline(self._pace, self.sockets.break_off, sent_bytes=len(content))
        asked_s = self._steady_s()
        try:
            with (
                deadline,
                self._client.stream(method, path, headers=sent, content=content, params=params) as response,
            ):
                self.traffic.up_bytes += len(content)
                was_answered, self._was_answered = self._was_answered, True
                if method not in CACHED:
                    found = time_sample(response.headers, asked_s=asked_s, answered_s=self._steady_s())
                    self._time = narrower(self._time, found)
                if not response.is_success and response.status_code != NOT_MODIFIED:
                    retry_after = response.headers.get("Retry-After", "")
                    error = error_of(response.status_code, retry_after, body_of_error(response))
                    # A proxy's answer in plain words to what its port of https does not take.
                    if error.kind == "http" and not was_answered and self._is_for_tls():
                        raise other_scheme(self._shown_url)
                    raise without_token(self.origin, error.message) if self._lacks_token(error) else error
                yield response, deadline
        except httpx.TransportError as exc:
            deadline.check()
            is_connected = not (self.sockets.is_cut or isinstance(exc, httpx.ConnectError | httpx.TimeoutException))
            if is_connected and not self._was_answered and self._is_for_tls():
                raise other_scheme(self._shown_url) from exc
            raise unreachable(exc, self._shown_url) from exc


def _vector_of(text: bytes | str) -> VersionVector:
    """Version vector of a text of an answer.

    Raises:
        DamagedDataError: it is none.
    """
    check_json_size(text)
    try:
        return version_vector_from_json(VECTOR.validate_json(text))
    except ValidationError as exc:
        raise DamagedDataError("bad_message", f"the server's version vector is not sound: {first_error(exc)}") from exc
