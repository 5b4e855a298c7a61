"""Table 3: how small the map is in each coding, with the numbers that the paper prints."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cairn_sim.experiment.figures import CodingTotals, ResolutionFigures
from cairn_sim.experiment.tables import MIB, MISSING, shown


@dataclass(frozen=True, slots=True)
class PaperColumn:
    """Column of the paper's Table 3 as printed for one resolution; MB, and the ratio's larger side."""

    cube: str
    compressed_cube: str
    uncompressed_map: str
    compressed_map: str
    ratio: str


PAPER_TABLE_3 = {
    40_000: PaperColumn("16", "0.081", "640", "8.5", "1:75"),
    20_000: PaperColumn("128", "0.544", "5120", "27.7", "1:185"),
}
"""By voxel edge in micrometres; the paper has no column for 8 cm."""
INCONSISTENT = (
    "Table 3 of the paper does not add up: compare ratios, and totals of as many cells. 640 MB in cubes of 16 MB are "
    "40 cubes, but the text counts 56 cells; 40 cubes of 0.081 MB are 3.2 MB, not 8.5, and 40 of 0.544 MB are 21.8 MB, "
    "not 27.7. Its ratios follow from the totals. The paper has no column for 8 cm. MB are 2^20 bytes, as the paper's "
    "16 MB for 128^3 voxels of 8 B."
)


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One resolution of Table 3: our column, and the paper's where it printed one."""

    title: str
    has_paper: bool


@dataclass(frozen=True, slots=True)
class TableRow:
    """One line of Table 3."""

    name: str
    cells: Sequence[tuple[str, str]] = ()
    """Text of each cell, and `paper` or nothing: whose it is."""
    kind: str = ""
    """`group`: a headline, without cells; `strong`: the line to compare."""


@dataclass(frozen=True, slots=True)
class TableThree:
    """Table 3 with the paper's columns next to ours."""

    columns: Sequence[TableColumn]
    rows: Sequence[TableRow]

    @property
    def width(self) -> int:
        """Columns of cells, that of the names included."""
        return 1 + len(self.columns) + sum(column.has_paper for column in self.columns)


def table_three(resolutions: Sequence[ResolutionFigures]) -> TableThree:
    """Table 3, the paper's columns next to ours."""
    papers = [PAPER_TABLE_3.get(round(one.voxel_edge_m * 1e6)) for one in resolutions]

    def row(
        name: str, ours: Callable[[ResolutionFigures], str], theirs: Callable[[PaperColumn], str], kind: str = ""
    ) -> TableRow:
        cells = []
        for one, paper in zip(resolutions, papers, strict=True):
            cells.append((ours(one), ""))
            if paper:
                cells.append((theirs(paper), "paper"))
        return TableRow(name, cells, kind)

    rows = [
        row("non-empty cells", lambda one: str(len(one.cells)), lambda _: "56 or 40"),
        row("cells with obstacles", lambda one: str(one.cells_with_obstacles), lambda _: MISSING),
        row("uncompressed cube, MB", lambda one: shown(one.cube_bytes / MIB), lambda paper: paper.cube),
        row(
            "uncompressed map, MB",
            lambda one: shown(one.uncompressed_bytes / MIB),
            lambda paper: paper.uncompressed_map,
        ),
    ]
    for name in resolutions[0].coding_names:
        rows += [
            TableRow(name, kind="group"),
            row("compressed cube, average, MB", _of(name, _mean_cell), lambda paper: paper.compressed_cube),
            row("compressed map, MB", _of(name, _map_size), lambda paper: paper.compressed_map),
            row("ratio", _of(name, _ratio), lambda paper: paper.ratio, "strong"),
            row("bits per occupied voxel", _of(name, _bits), lambda _: MISSING),
        ]
    columns = [TableColumn(one.title, paper is not None) for one, paper in zip(resolutions, papers, strict=True)]
    return TableThree(columns, rows)


def _of(coding: str, read: Callable[[CodingTotals], str]) -> Callable[[ResolutionFigures], str]:
    return lambda one: read(one.totals(coding))


def _mean_cell(total: CodingTotals) -> str:
    return shown(total.mean_cell_bytes / MIB)


def _map_size(total: CodingTotals) -> str:
    return shown(total.map_bytes / MIB)


def _ratio(total: CodingTotals) -> str:
    return f"1:{shown(total.ratio)}"


def _bits(total: CodingTotals) -> str:
    return MISSING if total.bits_per_occupied is None else shown(total.bits_per_occupied)
