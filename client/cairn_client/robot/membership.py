"""How a robot is known to the server: it registers when it must, and holds the token that it is given."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from cairn_client.http.api import MapApi
from cairn_client.replica.map_model import store_model
from cairn_client.replica.replica import Replica
from cairn_map.errors import BadInputError, DeniedError
from cairn_map.wire.messages import Mode, Register

T = TypeVar("T")

DOOR_KEY, OPEN = "door", "open"
"""Remembered of a robot that registered without any token: it can do so again."""


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
        """Use the robot's own token from here on, if it has one; else what it registers with, or an admin gave it."""
        self._api = api
        self._replica = replica
        self._map_name = map_name
        self._mode: Mode = mode
        self._sensors = list(sensors)
        self._enrolment_token = enrolment_token
        self._is_known_by_token = False
        api.token = replica.token() or enrolment_token

    def as_member(self, action: Callable[[], T]) -> T:
        """Do it as a robot that the server knows: register first if need be, and anew if the token is not good."""
        if self._replica.token() is None and not self._is_known_by_token:
            self._register()
        try:
            return action()
        except DeniedError as exc:
            if exc.kind != "bad_token":
                raise
            self._replica.set_token(None)  # the server was replaced, or somebody registered under this name
            self._is_known_by_token = False
            self._register()
            return action()

    def leave(self) -> None:
        """Deregister; the server forgets the token, and so does the robot."""
        self._api.deregister(self._map_name, self._replica.author.robot)
        self._replica.set_token(None)

    def leave_if_welcome_back(self) -> bool:
        """Deregister, unless the robot never registered or could not do it again; whether it left.

        One that an admin gave its token stays, and so does one that has nothing but the token in its folder.
        """
        with self._replica.lock:
            may_return = self._enrolment_token is not None or self._replica.store.get(DOOR_KEY) == OPEN
        if self._replica.token() is None or not may_return:
            return False
        self.leave()
        return True

    def _register(self) -> None:
        self._api.token = self._enrolment_token
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
        with self._replica.lock:
            store_model(self._replica.store, registered.map.sensor_model)
        self._replica.set_token(registered.token)
        with self._replica.lock, self._replica.store.transaction():
            self._replica.store.put(DOOR_KEY, OPEN if self._enrolment_token is None else None)
