"""Verdict on a solution, and its warnings in the order of their weight.

    not usable         something decisive is wrong: rig.json is not written, and the command ends with exit code 1
    usable with care   something may be wrong beyond the standard deviations, or a camera is poorly determined
    usable             the numbers hold within their standard deviations; notes say what could still be better

How large standard deviations may be depends on what the rig is for; as long as they hold, it is usable.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum


class Rank(IntEnum):
    """Weight of a warning."""

    NOTE = 0
    """Room for improvement; standard deviations hold."""
    CARE = 1
    """Errors beyond the standard deviations, perhaps, or a camera that is poorly determined."""
    DECISIVE = 2
    """Errors that make the solution useless."""


@dataclass(frozen=True, slots=True)
class SolveWarning:
    """One number that the images do not determine, or on which they contradict each other."""

    kind: str
    camera: str
    """Camera that it is about; empty for the whole rig."""
    measured: float
    threshold: float
    unit: str
    text: str
    """Meaning and advice."""
    rank: Rank = Rank.CARE

    @property
    def words(self) -> str:
        """Camera, meaning and advice."""
        return f"{self.camera}: {self.text}" if self.camera else self.text

    @property
    def severity(self) -> float:
        """Measured over threshold, or threshold over measured; comparable for one kind."""
        low, high = sorted((abs(self.measured), abs(self.threshold)))
        return high / max(low, 1e-3 * high, 1e-300)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.words} [{self.kind}: {self.measured:.3g}{unit}, threshold {self.threshold:.3g}{unit}]"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Use that may be made of a solution, and the decisive reason."""

    rank: Rank | None
    """Rank of the weightiest warning; None without any."""
    reason: str

    @property
    def is_usable(self) -> bool:
        """False if the rig must not be used."""
        return self.rank is not Rank.DECISIVE

    def __str__(self) -> str:
        word = {Rank.DECISIVE: "not usable", Rank.CARE: "usable with care"}.get(self.rank or Rank.NOTE, "usable")
        return f"{word}: {self.reason}"


def verdict_of(warnings: Sequence[SolveWarning], certainty: str) -> Verdict:
    """The verdict by ranked warnings; `certainty`, of a usable solution, says how certain it is."""
    if not warnings or warnings[0].rank is Rank.NOTE:
        return Verdict(warnings[0].rank if warnings else None, certainty)
    return Verdict(warnings[0].rank, warnings[0].words)


def ranked(warnings: Iterable[SolveWarning]) -> list[SolveWarning]:
    """Warnings by rank, then in the order in which their kinds come, the most severe of a kind first."""
    given = list(warnings)
    first: dict[str, int] = {}
    for n, each in enumerate(given):
        first.setdefault(each.kind, n)
    return sorted(given, key=lambda each: (-each.rank, first[each.kind], -each.severity))


def merged(warnings: Iterable[SolveWarning]) -> list[SolveWarning]:
    """Warnings to be read: notes that say the same of several cameras are one, of the worst, which names the others."""
    result: dict[object, SolveWarning] = {}
    others: dict[object, list[str]] = {}
    for n, each in enumerate(warnings):
        key: object = (each.kind, each.text) if each.rank is Rank.NOTE and each.camera else n
        if key in result:
            others.setdefault(key, []).append(each.camera)
        else:
            result[key] = each
    return [
        replace(each, text=f"{each.text} (likewise {', '.join(dict.fromkeys(others[key]))})") if key in others else each
        for key, each in result.items()
    ]
