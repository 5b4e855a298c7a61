"""The report's tables: rows of figures by resolution, each with its unit and one sentence of what it means."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from cairn_sim.experiment.figures import ResolutionFigures, quartiles

MIB = 1 << 20
KIB = 1 << 10
MISSING = "–"


def shown(value: float) -> str:
    """A number for people: three significant digits, no exponent."""
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}".replace(",", " ")
    digits = 2
    while digits < 6 and abs(value) < 10 ** (2 - digits):
        digits += 1
    return f"{value:.{1 if abs(value) >= 10 else digits}f}"


def percent(value: float | None) -> str:
    """A share, 0 to 1; None where it is not known."""
    if value is None or value != value:
        return MISSING
    return f"{value * 100:.2f} %" if value < 0.1 else f"{value * 100:.1f} %"


Read = Callable[[ResolutionFigures], str]


@dataclass(frozen=True, slots=True)
class FigureRow:
    """One figure at each resolution."""

    name: str
    """With its unit."""
    cells: Sequence[str]
    meaning: str
    """One sentence."""


@dataclass(frozen=True, slots=True)
class FigureTable:
    """Figures by resolution."""

    titles: Sequence[str]
    """Titles of the resolutions: `4 cm`."""
    rows: Sequence[FigureRow]


def figure_table(resolutions: Sequence[ResolutionFigures], rows: Sequence[tuple[str, Read, str]]) -> FigureTable:
    """A row for each figure: its name with the unit, its value at each resolution, its meaning."""
    return FigureTable(
        [one.title for one in resolutions],
        [FigureRow(name, [read(one) for one in resolutions], meaning) for name, read, meaning in rows],
    )


def fill_rows() -> list[tuple[str, Read, str]]:
    """Rows of the table at Fig. 22: how full the cells are."""
    return [
        (
            "occupied, median",
            lambda one: percent(median(one.filled("occupied"))),
            "Of a cell's voxels, those with a probability above one half: coarser voxels fill more of the volume.",
        ),
        (
            "known, median",
            lambda one: percent(median(one.filled("known"))),
            "Occupied or free: seen by at least one beam. The exact coding holds all of these.",
        ),
    ]


def time_rows(coding_names: Sequence[str]) -> list[tuple[str, Read, str]]:
    """Rows of the table at Fig. 23: times to encode and decode a cell."""
    rows: list[tuple[str, Read, str]] = [
        (
            "grid to rows, ms",
            lambda one: shown(1e3 * median(cell.pack_s for cell in one.cells)),
            "From the bricks in memory to sorted rows of known voxels; before every coding.",
        )
    ]
    for name in coding_names:
        rows += _coding_time_rows(name)
    rows.append(
        (
            "rows to grid, ms",
            lambda one: shown(1e3 * median(cell.unpack_s for cell in one.cells)),
            "Adding a cell's rows to an empty grid of bricks.",
        )
    )
    return rows


def _coding_time_rows(name: str) -> list[tuple[str, Read, str]]:
    def encode(one: ResolutionFigures) -> str:
        return shown(1e3 * one.totals(name).encode_median_s)

    def decode(one: ResolutionFigures) -> str:
        return shown(1e3 * one.totals(name).decode_median_s)

    def both(one: ResolutionFigures) -> str:
        return shown(one.totals(name).encode_median_s / one.totals(name).decode_median_s)

    return [
        (f"{name}: encode, ms", encode, "Rows to bytes, median of all cells."),
        (f"{name}: decode, ms", decode, "Bytes to rows or voxels, median."),
        (f"{name}: encode / decode", both, "The paper: about 10; storing tests all voxels, reading the occupied ones."),
    ]


def rate_rows() -> list[tuple[str, Read, str]]:
    """Rows of the table of speeds: images to evidence, commits, merges."""

    def rate(name: str, factor: float = 1.0) -> Read:
        return lambda one: shown(one.rates()[name] * factor)

    return [
        ("range images / s", rate("images_per_s"), "With their colour and thermal images; wall clock, all threads."),
        ("million rays / s", rate("rays_per_s", 1e-6), "A ray is a range pixel to which light came back; wall clock."),
        ("million rays / CPU s", rate("rays_per_cpu_s", 1e-6), "The same by CPU time of all threads together."),
        ("ms / measurement", rate("measurement_median_s", 1e3), "All scans of one stop to evidence; median, wall."),
        ("CPU ms / measurement", rate("measurement_median_cpu_s", 1e3), "The same by CPU time of all threads."),
        ("ms / commit", rate("commit_median_s", 1e3), "Writing that evidence as a commit; median, one thread."),
        ("ms / merge", rate("merge_median_s", 1e3), "Adding it to the map; median, one thread."),
        ("map in memory, MB", lambda one: shown(one.map_memory_bytes / MIB), "Bricks of the whole map."),
    ]


def commit_rows() -> list[tuple[str, Read, str]]:
    """Rows of the table of commit sizes."""

    def quartile(number: int) -> Read:
        return lambda one: shown(quartiles([float(m.commit_bytes) for m in one.measurements])[number] / KIB)

    return [
        ("smallest, kB", quartile(0), "Bytes that a robot sends for one stop, once; kB are 2^10 bytes."),
        ("median, kB", quartile(2), "Half of the commits are smaller."),
        ("largest, kB", quartile(4), "A commit of more than 64 MB would be refused."),
        (
            "all, MB",
            lambda one: shown(sum(m.commit_bytes for m in one.measurements) / MIB),
            "What the robots sent together; the map is smaller, because they saw most of it more than once.",
        ),
        (
            "cells in a commit, median",
            lambda one: f"{median(m.cells for m in one.measurements):g}",
            "That one stop adds evidence to.",
        ),
    ]


def truth_rows() -> list[tuple[str, Read, str]]:
    """Rows of the table of scores against the truth."""

    def score(name: str) -> Read:
        return lambda one: percent(getattr(one.truth.scores, name)) if one.truth else MISSING

    return [
        (
            "recall",
            score("recall"),
            "Of the surface voxels that the range camera could see, those that the map calls occupied.",
        ),
        (
            "carved away",
            score("carved"),
            "Of those, what the map calls free: an obstacle that is not there for a planner.",
        ),
        ("unknown", score("unknown"), "Of those, what the map knows nothing of."),
        (
            "precision",
            score("precision"),
            "Of the map's occupied voxels, those at most one voxel from something solid.",
        ),
        (
            "recall of free",
            score("recall_free"),
            "Of the voxels that a beam could pass, those that the map calls free.",
        ),
        (
            "false free",
            score("false_free"),
            "Of the map's free voxels, those that touch something solid, however little.",
        ),
        ("false free, half", score("false_free_half"), "Of the map's free voxels, those that are at least half solid."),
        (
            "cells compared",
            lambda one: f"{one.truth.cells} of {len(one.cells)}" if one.truth else MISSING,
            "Evenly chosen where they are not all.",
        ),
        (
            "truth looked at from",
            lambda one: f"{one.truth.poses} poses" if one.truth else MISSING,
            "Every fifth scan's; from them follows what could be seen.",
        ),
    ]
