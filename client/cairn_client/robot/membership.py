"""Membership of a robot on a map: it registers when it must, and holds the token that the server gives it.

    no token of this server's      register by the enrolment token: it is sent once, to the server that the URL names
    name bound to another key      register by the token and a proof of the robot's keys; else an operator must say so
    token refused                  register by a proof of the key alone, which an operator lets in
    map deleted                    the same, on a map that was made under its name since

A server that refuses a token may be a stranger in the right one's place, so no secret answers it: neither the enrolment
token nor anything that could be used elsewhere. A proof names the server that it is for, as the robot's URL names it.
"""

from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar, get_args

from cairn_calib.rig.rig import Rig
from cairn_client.http.api import MapApi
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState
from cairn_map.commits.key_proof import KeyProof, proof_bytes
from cairn_map.errors import BadInputError, CairnError, DeniedError, NotFoundError, UnreachableError
from cairn_map.wire.messages import Mode, Register, Registered
from cairn_map.wire.origins import origin_of

P = ParamSpec("P")
T = TypeVar("T")


def own_token(state: ReplicaState, url: str) -> str | None:
    """Token that a robot has from the server of this URL; None if it has none, or one of another server."""
    origin = state.token_origin or origin_of(state.url or url)
    return state.token if origin == origin_of(url) else None


def bind_token(state: ReplicaState, url: str) -> None:
    """Note whose token a folder of an earlier version has: it is of the server of its last use, else of this URL's."""
    if state.token is not None and state.token_origin is None:
        state.token_origin = origin_of(state.url or url)


class Membership:
    """One robot's place on one map."""

    def __init__(
        self,
        api: MapApi,
        replica: Replica,
        *,
        map_name: str,
        mode: Mode,
        sensors: Sequence[str],
        enrolment_token: str | None,
    ) -> None:
        """Use the robot's own token from here on, if it has one; else the one given, for enrolment or an admin's."""
        self._api = api
        self._replica = replica
        self._map_name = map_name
        self._mode: Mode = mode
        self._sensors = list(sensors)
        self._enrolment_token = enrolment_token
        self._is_known_by_token = False
        api.use_token(self._own_token or enrolment_token)

    @property
    def _own_token(self) -> str | None:
        return own_token(self._replica.state, self._api.origin)

    def as_member(self, action: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
        """Result of an action as a robot that the server knows; it registers first if it must.

        If the server does not take the robot's own token, it shows its key instead, and does the action again.

        Raises:
            DeniedError: kind `not_admitted`: an operator must let the robot in; or `bad_token`, and others.
            NotFoundError: kind `gone`: the map was deleted; nothing here changes by it.
        """
        if self._own_token is None and not self._is_known_by_token:
            self._register()
        try:
            return action(*args, **options)
        except DeniedError as exc:
            if exc.kind != "bad_token" or self._own_token is None:
                raise
            self._return(exc)
            return action(*args, **options)
        except NotFoundError as exc:
            if exc.kind != "gone" or self._own_token is None:
                raise
            self._join_namesake(exc)
            return action(*args, **options)

    def leave(self) -> None:
        """Deregister; the server forgets the token, and so does the robot."""
        self._api.deregister(self._map_name, self._replica.author.robot)
        self._replica.state.token = None

    def leave_if_welcome_back(self) -> bool:
        """Deregister, unless the robot never registered or could not do it again; True if it left.

        A robot whose token came from an admin stays, and so does one that has nothing but the token in its folder.
        """
        may_return = self._enrolment_token is not None or self._replica.state.may_register_openly
        if self._own_token is None or not may_return:
            return False
        self.leave()
        return True

    def _register(self) -> None:
        """Register by the token that was given, and by a proof of the keys where the name is known."""
        self._api.use_token(self._enrolment_token)
        try:
            self._keep(self._api.register(self._map_name, self._request()))
        except DeniedError as exc:
            if exc.kind == "not_allowed":
                self._is_known_by_token = True  # perhaps an admin gave the robot a token; else the next ask says
                return
            if exc.kind != "not_admitted":
                raise
            self._keep(self._proven_registration(refusal=exc))

    def _return(self, refusal: DeniedError) -> None:
        """Register again where the robot's own token is refused, without showing any token."""
        token, self._api.token = self._api.token, None
        try:
            if self._replica.state.may_register_openly:
                try:  # it needed no token before
                    self._keep(self._api.register(self._map_name, self._request()))
                    return
                except DeniedError:
                    pass
            self._keep(self._proven_registration(refusal=refusal))
        except BaseException:
            self._api.use_token(token)
            raise

    def _join_namesake(self, refusal: NotFoundError) -> None:
        """Register on a map of the name of a deleted one, if an operator lets this robot in there.

        Not openly, even where that is allowed: evidence of a map that was deleted comes to another one by a person's
        word alone.

        Raises:
            NotFoundError: the refusal: there is no such map, or the robot is not let in.
        """
        token, self._api.token = self._api.token, None
        try:
            # A server that wants no tokens would take any robot.
            if self._replica.state.may_register_openly and not self._is_let_in():
                raise DeniedError(refusal.kind, refusal.message)
            self._keep(self._proven_registration(refusal=DeniedError(refusal.kind, refusal.message)))
        except BaseException as exc:
            self._api.use_token(token)
            if isinstance(exc, DeniedError):
                raise refusal from exc
            raise

    def _is_let_in(self) -> bool:
        """True if an operator's word for this robot's key waits at a server that wants no tokens."""
        own = str(self._replica.author)
        return any(key.author == own and key.may_return for key in self._api.keys(self._map_name).admitted)

    def _proven_registration(self, *, refusal: DeniedError) -> Registered:
        """Registration with a proof of the robot's keys.

        Raises:
            DeniedError: the server says no for another reason than that of the refusal, or asks for an operator.
        """
        author = self._replica.author
        try:
            challenge = self._api.challenge()
            asked = self._api.origin
            signed = self._replica.sign_bytes(proof_bytes(asked, self._map_name, author, challenge))
            proof = KeyProof(author, challenge, asked, signed).to_text()
            return self._api.register(self._map_name, self._request(), proof=proof)
        except UnreachableError:
            raise
        except CairnError as exc:
            if exc.kind == "other_origin":
                raise DeniedError(refusal.kind, f"the server does not take this robot's proof: {exc.message}") from exc
            raise DeniedError(
                refusal.kind,
                f"the server does not let this robot in: {refusal.message}. The robot maps on, and keeps its commits. "
                f"If {self._api.origin} is the right server, ask an operator for: cairn map robots admit "
                f"{self._api.origin}/maps/{self._map_name} {author}",
            ) from exc

    def _request(self) -> Register:
        author = self._replica.author
        return Register(robot=author.robot, mode=self._mode, incarnation=author.incarnation, sensors=self._sensors)

    def _keep(self, registered: Registered) -> None:
        layer = registered.map.layer
        here, is_fresh = self._replica.layer, self._replica.header is None
        if is_fresh and layer.has_epochs and not here.has_epochs and layer.geometry == here.geometry:
            # A robot that began without a link could not know of the map's epochs.
            self._replica.take_epochs(layer)
        if layer != self._replica.layer:
            raise BadInputError(
                "other_geometry",
                f"map {self._map_name} has {layer}; this robot's directory has "
                f"{self._replica.layer}. Its {len(self._replica.push_set())} waiting commits stay there: push them "
                "to a map with their grid, and give the robot another directory for this map",
            )
        state = self._replica.state
        state.note_model(registered.map.sensor_model)
        with state.store.transaction():
            state.token = registered.token
            state.token_origin = self._api.origin
            state.may_register_openly = self._enrolment_token is None


def check_kinds(rig: object, mode: object) -> None:
    """Check what a robot is opened with, as far as a caller without a type checker may confuse it.

    Raises:
        BadInputError: `rig` is no rig, such as the path of one, or there is no such mode.
    """
    # `load_rig` takes a path and `Robot` a rig: without this, the path fails later, as an attribute that is missing.
    if rig is not None and not isinstance(rig, Rig):
        raise BadInputError("bad_rig", f"a rig is expected, got {type(rig).__name__}: cairn.load_rig(path) reads one")
    # A mode that is none would be found out by the server, and only when there is a link.
    if mode not in get_args(Mode):
        raise BadInputError("bad_mode", f"the mode is one of {', '.join(get_args(Mode))}; got {mode!r}")
