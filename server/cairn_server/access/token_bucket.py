"""How often something may happen: so many times at once, and every moment some more."""

from dataclasses import dataclass


@dataclass(slots=True)
class Allowance:
    """What is left of one; not thread-safe."""

    most: float
    """At once."""
    per_s: float
    left: float
    seen_s: float

    def take(self, now_s: float) -> float:
        """Once, at a time that does not fall; 0, or the seconds to wait, and nothing is taken."""
        self.left = min(self.most, self.left + (now_s - self.seen_s) * self.per_s)
        self.seen_s = now_s
        if self.left < 1:
            return (1 - self.left) / self.per_s
        self.left -= 1
        return 0.0


def allowance(most: float, per_s: float, *, now_s: float) -> Allowance:
    """A whole one."""
    return Allowance(most, per_s, most, now_s)
