"""The keys by which a robot signs its commits: one for each of its incarnations, in its file beside its token.

A key and the incarnation that follows from it are drawn together. Older ones are kept: what an older incarnation
committed may still be waiting, or be taken back.
"""

from cairn_client.replica.replica_store import ReplicaStore
from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Incarnation, RobotName
from cairn_map.commits.signature import SIGNATURES_MAX, SigningKey, signatures_to_text


class RobotKeys:
    """One robot's keys; called under the replica's lock."""

    def __init__(self, store: ReplicaStore, robot: RobotName) -> None:
        self._store = store
        self._robot = robot

    def has(self, incarnation: Incarnation) -> bool:
        """Whether this incarnation's commits can be signed."""
        return self._key(incarnation) is not None

    def draw(self) -> Incarnation:
        """A new key, in a transaction of the caller's, and the incarnation that is its."""
        key = SigningKey.drawn()
        self._store.put(_name(key.incarnation), key.seed.hex())
        return key.incarnation

    def signatures(self, commit: Commit) -> str | None:
        """On an own commit, by its incarnation and by those that it takes from; None if none of them has a key."""
        spoken_for = dict.fromkeys([commit.id.author, *(target.author for target in commit.meta.retracted_ids)])
        own = [author.incarnation for author in spoken_for if author.robot == self._robot]
        keys = [key for incarnation in own if (key := self._key(incarnation)) is not None]
        if commit.id.author.robot != self._robot or not keys:
            return None
        map_name = self._store.get("map") or ""
        return signatures_to_text([key.sign(map_name, commit.sha) for key in keys[:SIGNATURES_MAX]])

    def _key(self, incarnation: Incarnation) -> SigningKey | None:
        seed = self._store.get(_name(incarnation))
        return SigningKey(bytes.fromhex(seed)) if seed else None


def _name(incarnation: Incarnation) -> str:
    return f"signing_key.{incarnation}"
