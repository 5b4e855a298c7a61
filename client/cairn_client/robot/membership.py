"""Membership of a robot on a map: it registers when it must, and holds the token that the server gives it."""

from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

from cairn_client.http.api import MapApi
from cairn_client.http.origin_tokens import origin_of
from cairn_client.replica.replica import Replica
from cairn_client.replica.replica_state import ReplicaState
from cairn_map.errors import BadInputError, DeniedError
from cairn_map.wire.messages import Mode, Register

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

        If the server does not take the token, it registers again, and does the action again.
        """
        if self._own_token is None and not self._is_known_by_token:
            self._register()
        try:
            return action(*args, **options)
        except DeniedError as exc:
            if exc.kind != "bad_token":
                raise
            self._replica.state.token = None  # the server was replaced, or another robot registered under this name
            self._is_known_by_token = False
            self._register()
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
        self._api.use_token(self._enrolment_token)
        author = self._replica.author
        request = Register(robot=author.robot, mode=self._mode, incarnation=author.incarnation, sensors=self._sensors)
        try:
            registered = self._api.register(self._map_name, request)
        except DeniedError as exc:
            if exc.kind != "not_allowed":
                raise
            self._is_known_by_token = True  # perhaps an admin gave the robot a token of its own; else the next ask says
            return
        if registered.map.geometry != self._replica.geometry:
            raise BadInputError("other_geometry", f"map {self._map_name} has another grid than this robot's directory")
        self._replica.state.note_model(registered.map.sensor_model)
        with self._replica.state.store.transaction():
            self._replica.state.token = registered.token
            self._replica.state.token_origin = self._api.origin
            self._replica.state.may_register_openly = self._enrolment_token is None
