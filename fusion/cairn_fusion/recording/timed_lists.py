"""Text files of one time stamp a line: `time rest of the line`, `#` starts a comment line.

    1700000000.00  images/left/000000.png
    1700000000.25  images/left/000001.png

Times increase strictly. Errors read `file:line: what was expected, what came`. The caller parses the rest of a line: a
path, a pose, a reading.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from cairn_map.errors import BadInputError

LIST_BYTES_MAX = 64 << 20
"""Largest list: some 700 000 lines of a trajectory, ten hours at 20 Hz."""

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Line:
    """One line that is no comment, with its file and number."""

    path: Path
    number: int
    text: str

    def error(self, reason: str, kind: str = "bad_recording") -> BadInputError:
        """The error that names this line; for `raise`."""
        return BadInputError(kind, f"{self.path}:{self.number}: {reason}")

    def numbers(self, text: str, count: int) -> list[float]:
        """Exactly `count` finite numbers in a part of the line."""
        words = text.split()
        if len(words) != count:
            raise self.error(f"{count} numbers expected, got {len(words)} words")
        try:
            values = [float(word) for word in words if "_" not in word]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise self.error(f"finite numbers expected, got {text[:120]!r}")
        return values


@dataclass(frozen=True, slots=True)
class TimedList(Generic[Value]):
    """Values at strictly increasing times, seconds."""

    times_s: npt.NDArray[np.float64]
    values: tuple[Value, ...]

    def __len__(self) -> int:
        return len(self.values)

    def nearest(self, time_s: float, *, max_gap_s: float) -> Value | None:
        """The value nearest in time, at most `max_gap_s` away, the earlier of two equally near; else None."""
        after = int(np.searchsorted(self.times_s, time_s))
        near = [(abs(float(self.times_s[i]) - time_s), i) for i in (after - 1, after) if 0 <= i < len(self)]
        gap_s, index = min(near, default=(math.inf, -1))
        return self.values[index] if gap_s <= max_gap_s else None


def timed_list(path: Path, parse: Callable[[Line, str], Value]) -> TimedList[Value]:
    """A whole file, each line's rest read by `parse`.

    Raises:
        BadInputError: unreadable, too large, not text, or a line without a time later than the line before.
    """
    times_s: list[float] = []
    values: list[Value] = []
    for line in lines(path):
        time_s, rest = time_and_rest(line)
        if times_s and time_s <= times_s[-1]:
            raise line.error(f"times must increase, got {time_s!r} after {times_s[-1]!r}")
        times_s.append(time_s)
        values.append(parse(line, rest))
    return TimedList(np.array(times_s, dtype=np.float64), tuple(values))


def time_and_rest(line: Line) -> tuple[float, str]:
    """The time that a line starts with, and the rest, which must not be empty."""
    word, _, rest = line.text.replace("\t", " ").partition(" ")
    (time_s,) = line.numbers(word, 1)
    if not rest.strip():
        raise line.error("something must follow the time")
    return time_s, rest.strip()


def lines(path: Path) -> Iterator[Line]:
    """The lines of a text file that are neither blank nor comments.

    Raises:
        BadInputError: missing, larger than `LIST_BYTES_MAX`, or not UTF-8.
    """
    text = read_text(path, LIST_BYTES_MAX)
    for number, raw in enumerate(text.split("\n"), start=1):
        stripped = raw.strip()
        if stripped and not stripped.startswith("#"):
            yield Line(path, number, stripped)


def read_text(path: Path, size_bytes_max: int) -> str:
    """A whole small text file.

    Raises:
        BadInputError: missing, not a plain file, too large, or not UTF-8.
    """
    try:
        if not path.is_file():
            raise BadInputError("missing_file", f"{path} is missing, or is no file")
        with path.open("rb") as file:
            data = file.read(size_bytes_max + 1)
        text = data.decode()
    except OSError as exc:
        raise BadInputError("missing_file", f"cannot read {path}: {exc.strerror}") from exc
    except UnicodeDecodeError as exc:
        raise BadInputError("bad_recording", f"{path} must be UTF-8 text: {exc.reason} at byte {exc.start}") from exc
    if len(data) > size_bytes_max:
        raise BadInputError("bad_recording", f"{path} must be at most {size_bytes_max} bytes, and is larger")
    return text
