"""Link profiles: how a robot divides a link's bytes between commits, cells and status.

    good     whole commits, fast to make; replies as long as they get; a status with every sync that has one to tell
    small    some ten kbit/s to some hundred, with losses: commits of few bytes, in small parts; short replies, so that
             what comes next is always what is nearest now; rounds that end soon, so that commits do not wait for the
             map; a status once a minute

On every link the cells around the robot come first.
"""

from dataclasses import dataclass, replace
from typing import Literal

from cairn_client.sync.scope import Scope
from cairn_client.sync.uploads import PARTS, Parts
from cairn_map.codec.cell_code import Profile

LinkName = Literal["good", "small"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkProfile:
    """The settings of one kind of link."""

    commits: Profile = Profile.FAST
    parts: Parts = PARTS
    reply_bytes_max: int | None = None
    round_bytes_max: int | None = None
    tell_every_s: float = 0.0
    """Least seconds between two status reports."""

    def scope_of(self, scope: Scope) -> Scope:
        """A scope, with this link's limits where it names none."""
        return replace(
            scope,
            reply_bytes_max=scope.reply_bytes_max or self.reply_bytes_max,
            round_bytes_max=scope.round_bytes_max or self.round_bytes_max,
        )


LINKS: dict[LinkName, LinkProfile] = {
    "good": LinkProfile(),
    # At 64 kbit/s a part takes 2 s, a reply 8 s or as long as its last cell, a round some 16 s.
    "small": LinkProfile(
        commits=Profile.SMALL,
        parts=Parts(above_bytes=1 << 15, part_bytes=1 << 14),
        reply_bytes_max=1 << 16,
        round_bytes_max=1 << 17,
        tell_every_s=60.0,
    ),
}
