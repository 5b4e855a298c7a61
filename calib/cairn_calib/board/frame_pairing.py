"""Frames: images of one place of the board by several cameras, paired by a text in their names.

    left/left01.png, ...      -> 01       Without --frame a name's words and numbers are taken apart. The parts that are
    right/0001-cam1.jpg, ...  -> 0001     the same in all names of a folder are the camera's (`left`, `cam1`) and fall
    2026-11-21_tof_3, ...     -> 2026-11-21-3    out, but for numbers of three digits and more: a day or a session.

A frame is a text and no number: 200 and 0200 are two frames, which may be images of different moments.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

from cairn_map.errors import BadInputError

PART = re.compile(r"[0-9]{4}[-_.][0-9]{2}[-_.][0-9]{2}(?![0-9])|[0-9]+|[^\W\d_]+")
"""A day, a number, or a word; what stands between them separates."""
TELLING_DIGITS = 3
"""Digits of a number that is kept though it is the same in all names: fewer count cameras, as in `cam1`."""
SHOWN = 3
"""Frames at either end of a list that are shown."""


def frames_of(names: Sequence[str], pattern: str | None = None) -> list[str]:
    """The frame of each image of one camera, by its name without suffix.

    Args:
        names: of all images of the camera, each different.
        pattern: a regular expression whose only group is the frame; None: found by comparing the names.

    Raises:
        BadInputError: it is no such expression, or a name does not match.
    """
    if pattern is not None:
        return _matched(names, pattern)
    parts = [[re.sub("[_.]", "-", part) for part in PART.findall(name)] for name in names]
    lead, trail = _common(parts), _common([each[::-1] for each in parts])
    aligned = len({len(each) for each in parts}) == 1
    result = []
    for name, each in zip(names, parts, strict=True):
        kept = []
        for at, part in enumerate(each):
            same = at < lead or len(each) - at <= trail or (aligned and len({row[at] for row in parts}) == 1)
            telling = part[0].isdecimal() and (len(part) >= TELLING_DIGITS or len(names) == 1)
            if telling or not same:
                kept.append(part)
        result.append("-".join(kept) or name)
    return result


def refuse_unpaired(frames: Mapping[str, Sequence[str]], examples: Mapping[str, str]) -> None:
    """Check that frames connect all cameras, and still do without any one of them.

    Args:
        frames: those in which each camera saw the board.
        examples: an image's name for each camera, with its frame.

    Raises:
        BadInputError: they do not.
    """
    first, *others = _groups({camera: set(own) for camera, own in frames.items()})
    if others:
        lost = others[0]
        raise BadInputError(
            "not_observable",
            f"no board was seen by {', '.join(lost)} together with {', '.join(first)}, so that nothing tells where one "
            f"is from the other: {_shown(first[0], frames, examples)}, {_shown(lost[0], frames, examples)}. If names "
            "of one moment differ, say with --frame REGEX which part of a name counts the moments; if not, take images "
            "of boards that both see at the same time",
        )
    for frame in sorted(set().union(*frames.values())):
        first, *others = _groups({camera: set(own) - {frame} for camera, own in frames.items()})
        if others:
            raise BadInputError(
                "not_observable",
                f"{', '.join(others[0])} and {', '.join(first)} saw the board together in one frame alone, {frame}, so "
                f"that nothing checks where one is from the other: {_shown(first[0], frames, examples)}, "
                f"{_shown(others[0][0], frames, examples)}. If names of one moment differ, say with --frame REGEX "
                "which part of a name counts the moments; if not, take more images of boards that both see at the same "
                "time",
            )


def pairing_table(frames: Mapping[str, Sequence[str]], examples: Mapping[str, str]) -> str:
    """Lines that show which frames each camera saw, and how many of them two cameras share.

    Arguments are those of `refuse_unpaired`.
    """
    rows = [("camera", "boards", "frame of a name", "frames")]
    rows += [(name, str(len(own)), examples.get(name, ""), shortened(own)) for name, own in frames.items()]
    camera, example = (max(len(row[column]) for row in rows) for column in (0, 2))
    lines = [f"{row[0]:<{camera}}  {row[1]:>6}  {row[2]:<{example}}  {row[3]}" for row in rows]
    shared = {pair: len({*frames[pair[0]]} & {*frames[pair[1]]}) for pair in combinations(frames, 2)}
    if len(shared) > 1 and len(set(shared.values())) == 1:
        lines.append(f"frames that any two of them both saw: {next(iter(shared.values()))}")
    elif shared:
        told = (f"{one} and {two} {count}" for (one, two), count in shared.items())
        lines.append(f"frames that both saw: {', '.join(told)}")
    return "\n".join(line.rstrip() for line in lines) + "\n"


def shortened(frames: Iterable[str]) -> str:
    """`01, 02, 03 ... 12, 13, 14`: frames in the order of their numbers."""
    told = sorted(frames, key=lambda frame: [(len(part), part) for part in re.findall(r"[0-9]+|[^0-9]+", frame)])
    if len(told) <= 2 * SHOWN:
        return ", ".join(told) or "none"
    return f"{', '.join(told[:SHOWN])} ... {', '.join(told[-SHOWN:])}"


def _matched(names: Sequence[str], pattern: str) -> list[str]:
    try:
        compiled = re.compile(pattern)
    except re.error as exc:
        raise BadInputError("bad_arguments", f"--frame {pattern!r} is no regular expression: {exc}") from exc
    if compiled.groups != 1:
        raise BadInputError(
            "bad_arguments",
            f"--frame must have one group, the part of a name that counts the moments, such as '([0-9]+)$', and "
            f"{pattern!r} has {compiled.groups}",
        )
    found = {name: compiled.search(name) for name in names}
    lost = [name for name, match in found.items() if match is None or not match[1]]
    if lost:
        more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise BadInputError(
            "bad_arguments", f"--frame {pattern!r} finds nothing in {lost[0]}{more}, the name without its suffix"
        )
    return [match[1] for match in found.values() if match is not None]


def _common(rows: Sequence[Sequence[str]]) -> int:
    """Number of first items that are the same in all rows."""
    count = 0
    for items in zip(*rows, strict=False):
        if len(set(items)) > 1:
            return count
        count += 1
    return count


def _groups(frames: Mapping[str, set[str]]) -> list[list[str]]:
    """Cameras that share frames, directly or by way of others; the group of the first camera first."""
    left, groups = list(frames), []
    while left:
        group = [left.pop(0)]
        for camera in group:
            joined = [other for other in left if frames[camera] & frames[other]]
            group += joined
            left = [other for other in left if other not in joined]
        groups.append(group)
    return groups


def _shown(camera: str, frames: Mapping[str, Sequence[str]], examples: Mapping[str, str]) -> str:
    example = f" ({examples[camera]})" if camera in examples else ""
    return f"the frames of {camera} are {shortened(frames[camera])}{example}"
