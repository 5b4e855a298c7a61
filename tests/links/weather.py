"""Faults at random: the same seed, the same faults, connection by connection."""

from random import Random

from tests.links.proxy import NO_FAULT, Cut, Fault

CUTS: tuple[Cut, ...] = ("close", "half", "reset")


class Weather:
    """What befalls the connections of one link."""

    def __init__(self, random: Random, *, mean_bytes: float) -> None:
        """Each connection is cut, after so many bytes on an average, or before one of its first answers."""
        self._random = random
        self._mean_bytes = mean_bytes
        self.is_fair = False
        """Nothing befalls them any more."""

    def __call__(self) -> Fault:
        """Of the next connection."""
        random = self._random
        if self.is_fair:
            return NO_FAULT
        delay_s, cut = random.choice((0.0, 0.0, 0.002, 0.03)), random.choice(CUTS)
        size_bytes = random.expovariate(1 / self._mean_bytes)
        match random.randrange(3):
            case 0:
                return Fault(delay_s=delay_s, cut=cut, up_bytes=size_bytes)
            case 1:
                return Fault(delay_s=delay_s, cut=cut, down_bytes=size_bytes)
        return Fault(delay_s=delay_s, cut=cut, answers=random.randint(1, 20))
