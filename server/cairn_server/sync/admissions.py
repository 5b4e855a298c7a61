"""Admission of robots' keys: proofs that robots show, an operator's word, and those that wait for it.

The rule is that of `store.admission`; the store holds it, in the transaction of each commit and registration. Robots
that were refused are remembered for the operator, in memory: they ask again. Names share the places on this list
(`access.shared_places`): a thief that asks with key after key hides no other robot that asks.
"""

import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from cairn_map.commits.ids import Author, Incarnation
from cairn_map.commits.key_proof import KeyProof
from cairn_map.errors import CairnError, DeniedError, UnreachableError
from cairn_map.wire.access_messages import AskingRobot, KeyInfo, RobotKeyList
from cairn_server.access.auth import Caller, Role, check_robot_name
from cairn_server.access.challenges import Challenges, check_origin
from cairn_server.access.rate_limits import HOUR_S, Buckets, TurnBuckets
from cairn_server.access.shared_places import SharedPlaces
from cairn_server.settings import Quotas
from cairn_server.store.admission import Grounds
from cairn_server.store.store import Store
from cairn_server.store.store_rows import MapRow

ASKING_MAX = 64
"""Refused robots of one map that are remembered."""
_Asking = SharedPlaces[Author, AskingRobot]


class Admissions:
    """Keys of the robots of a store's maps; called from many threads."""

    def __init__(self, store: Store, quotas: Quotas, *, steady_s: Callable[[], float] = time.monotonic) -> None:
        shared = store.replicas
        # A robot shows the proof to any server of the store: they share the secret, and the time of day.
        self.challenges = (
            Challenges(steady_s=steady_s) if shared is None else Challenges(secret=shared.secret, steady_s=time.time)
        )
        self._turns: Buckets = TurnBuckets(steady_s=steady_s) if shared is None else shared.uses
        """Registrations left to each enrolment token."""
        self._store = store
        self._per_hour = quotas.registrations_per_hour
        self._lock = threading.Lock()
        self._asking: defaultdict[int, _Asking] = defaultdict(lambda: _Asking(ASKING_MAX))
        """By map; the asker is the name."""

    def returning(self, map_name: str, proof_text: str, *, own: frozenset[str]) -> Caller:
        """Caller that shows no token, but the key of a robot that an operator lets in: it may register this robot.

        Args:
            map_name: map that the robot wants to be on.
            proof_text: text of the header `Cairn-Proof`.
            own: origins of this server, as in `access.own_names`.

        Raises:
            BadInputError: kind `other_origin`: the proof was made for another server; kind `bad_signature`,
                `bad_name` or `bad_id`: it is malformed.
            DeniedError: kind `no_token`: no operator said so, or the proof does not hold. It does not say which, nor
                whether there is such a map.
        """
        proof = KeyProof.from_text(proof_text)
        check_origin(proof, own=own)
        with suppress(CairnError):
            row = self._store.map(map_name)
            key = self._store.keys.of(row, proof.author.robot).get(proof.author.incarnation)
            may_return = key is not None and key.may_return
            if may_return and proof.author.incarnation in self.challenges.signers(proof, map_name=row.name, own=own):
                return Caller(Role.ENROLLER, proof.author.robot, str(proof.author), row.number, is_returning=True)
        raise DeniedError(
            "no_token",
            "this takes a token, or the key of a robot that an operator let in: cairn map robots admit URL NAME.KEY",
        )

    @contextmanager
    def registering(
        self, row: MapRow, caller: Caller, author: Author, proof_text: str | None, *, own: frozenset[str]
    ) -> Iterator[Grounds]:
        """Context of a registration, with the grounds of its caller; one that fails costs no quota.

        `own`: origins of this server, as in `access.own_names`.

        Raises:
            DeniedError: kind `not_allowed`: the token is for another robot.
            BadInputError: kind `bad_signature` or `other_origin`: the proof does not hold.
            UnreachableError: kind `quota`: the enrolment token registered too many for now.
        """
        is_for_robot = caller.robot == author.robot
        if not is_for_robot and caller.robot is not None:
            raise DeniedError("not_allowed", f"the token shown is not for {author.robot}")
        signers: frozenset[Incarnation] = frozenset()
        if proof_text is not None:
            proof = KeyProof.from_text(proof_text)
            signers = self.challenges.signers(proof, map_name=row.name, own=own) if proof.author == author else signers
        has_word = caller.role is Role.ADMIN or (caller.role is Role.ENROLLER and is_for_robot)
        self._take(caller)
        try:
            yield Grounds(signers=signers, has_word=has_word, is_return=caller.is_returning, by=caller.name)
        except CairnError as exc:
            if exc.kind == "not_admitted":
                self.refused(row, author, by=caller)
            self._give_back(caller)
            raise
        with self._lock:
            self._asking[row.number].remove(author)

    def admit(self, row: MapRow, author: Author, *, by: Caller) -> None:
        """Admit a key by an operator's word; durable on return.

        Raises:
            BadInputError: kind `reserved_name`: servers speak in this name.
        """
        check_robot_name(author.robot)
        self._store.keys.admit(row, author, by=by.name)
        self._store.audit_log.add(by.name, "admit", f"map {row.name}: {author}", client=by.address)
        with self._lock:
            self._asking[row.number].remove(author)

    def refused(self, row: MapRow, author: Author, *, by: Caller) -> None:
        """Remember a robot that was refused for its key."""
        with self._lock:
            asking, now_s = self._asking[row.number], time.time()
            before = asking.get(author.robot, author)
            since_s = before.since_s if before else now_s
            robot = AskingRobot(author=str(author), since_s=since_s, asked_s=now_s, by=by.name)
            asking.put(author.robot, author, robot)

    def list(self, row: MapRow) -> RobotKeyList:
        """Admitted keys, and the robots that ask to be; not those that were let in since they asked."""
        keys = [
            KeyInfo(author=str(key.author), since_s=key.since_s, by=key.by, may_return=key.may_return)
            for key in self._store.keys.all(row)
        ]
        since_s = {key.author: key.since_s for key in keys}
        with self._lock:
            asking = sorted(self._asking[row.number].values(), key=lambda robot: robot.asked_s)
        asking = [robot for robot in asking if robot.asked_s >= since_s.get(robot.author, 0.0)]
        return RobotKeyList(admitted=keys, asking=asking)

    def _take(self, caller: Caller) -> None:
        if caller.role is not Role.ENROLLER or self._per_hour is None:
            return
        wait_s = self._turns.take_turn(_bucket(caller), most=self._per_hour, per_s=self._per_hour / HOUR_S)
        if wait_s:
            message = f"the token {caller.name} may register {self._per_hour} robots an hour"
            raise UnreachableError("quota", message, retry_after_s=math.ceil(wait_s))

    def _give_back(self, caller: Caller) -> None:
        if caller.role is Role.ENROLLER and self._per_hour is not None:
            self._turns.give_turn(_bucket(caller))


def _bucket(caller: Caller) -> str:
    return f"registrations {caller.name}"
