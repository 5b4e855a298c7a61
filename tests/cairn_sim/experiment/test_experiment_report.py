"""The report of made-up figures: sums and ratios known by hand, sound HTML, the paper's numbers next to ours."""

import numpy as np
import pytest
from tests.fixtures.sim.pages import read_page

from cairn_sim.evaluation.scores import Scores
from cairn_sim.experiment.codings import CODINGS
from cairn_sim.experiment.figures import (
    CellFigures,
    CodedCell,
    MeasurementFigures,
    ResolutionFigures,
    RunFigures,
    TruthFigures,
    paper_geometry,
)
from cairn_sim.experiment.plan import PlanView
from cairn_sim.experiment.report import report_page
from cairn_sim.experiment.tables import percent, shown

SCORES = Scores(surface=100, surface_occupied=90, surface_free=3, free=50, free_free=50, map_free=50, map_occupied=95)


def resolution(edge_m: float, *, truth: bool = True) -> ResolutionFigures:
    geometry = paper_geometry(edge_m)
    sizes = (100_000, 300_000)
    cells = [
        CellFigures(
            cell=f"{n},0,0",
            known=geometry.side**3 // 2,
            occupied=n * geometry.side,
            pack_s=0.001,
            unpack_s=0.002,
            coded={
                coding.name: CodedCell(size_bytes=size, encode_s=0.01 * (n + 1), decode_s=0.001) for coding in CODINGS
            },
        )
        for n, size in enumerate(sizes)
    ]
    measurement = MeasurementFigures(
        robot="labs",
        stop=0,
        scans=36,
        rays=900_000,
        integrate_s=0.5,
        integrate_cpu_s=0.9,
        commit_s=0.1,
        merge_s=0.01,
        commit_bytes=4096,
        cells=2,
        voxels=5000,
    )
    return ResolutionFigures(
        voxel_edge_m=edge_m,
        side=geometry.side,
        map_memory_bytes=1 << 20,
        measurements=[measurement],
        cells=cells,
        truth=TruthFigures(cells=2, poses=8, scores=SCORES) if truth else None,
    )


def page_of(*edges_m: float, asked: tuple[str, ...] = (), truth: bool = True) -> str:
    run = RunFigures(about={"robot": "<orpheus>", "stops": None}, asked=asked)
    run.resolutions += [resolution(edge_m, truth=truth) for edge_m in edges_m]
    return report_page(run, PlanView(paper_geometry(edges_m[-1]), 0.9), [("labs", [np.eye(4)])])


def test_totals_are_the_papers_arithmetic() -> None:
    four = resolution(0.04)
    assert four.cube_bytes == 16 << 20 and four.uncompressed_bytes == 32 << 20
    total = four.totals(CODINGS[0].name)
    assert (total.mean_cell_bytes, total.map_bytes) == (200_000, 400_000)
    assert total.ratio == pytest.approx((32 << 20) / 400_000)
    assert total.encode_median_s == pytest.approx(0.015)
    assert total.bits_per_occupied == pytest.approx(8 * 400_000 / 128)
    assert resolution(0.02).cube_bytes == 128 << 20
    assert four.cells_with_obstacles == 1
    assert four.rates()["rays_per_cpu_s"] == pytest.approx(1e6)


def test_the_page_is_sound_html_with_nothing_from_outside() -> None:
    page = read_page(page_of(0.08, 0.04, 0.02, asked=("8 cm", "4 cm", "2 cm")))
    assert not page.tags & {"script", "link", "iframe", "img"}
    references = [value for name, value in page.attributes if name in ("href", "src", "xlink:href")]
    # A chart refers to its own marks (`#...`), a plan to the picture in it.
    assert references and all(value.startswith(("data:image/png;base64,", "#")) for value in references)
    assert "url(" not in " ".join(page.words)
    assert all(value.startswith("url(#") for _, value in page.attributes if "url(" in value)
    assert "<orpheus>" in page.words


def test_the_page_has_the_papers_table_beside_ours() -> None:
    words = read_page(page_of(0.08, 0.04, 0.02)).words
    for printed in ("16", "128", "0.081", "0.544", "640", "5120", "8.5", "27.7", "1:75", "1:185"):
        assert words.count(printed) >= 1, printed
    assert any("does not add up" in word for word in words)
    for coding in CODINGS:
        assert coding.name in words and coding.holds in words


@pytest.mark.slow
def test_a_resolution_that_the_paper_has_not_stands_alone() -> None:
    assert "paper" not in read_page(page_of(0.08)).words
    words = read_page(page_of(0.08, 0.04)).words
    assert words.count("ours") == 2 and words.count("paper") == 1


def test_what_was_not_finished_is_said() -> None:
    assert "Not finished" not in page_of(0.08, asked=("8 cm",))
    assert "Not finished: 4 cm, 2 cm was" in page_of(0.08, asked=("8 cm", "4 cm", "2 cm"))


@pytest.mark.slow
def test_without_a_truth_the_page_says_so() -> None:
    assert "90.0 %" in page_of(0.08)
    page = page_of(0.08, truth=False)
    assert "90.0 %" not in page and "is not known" in page


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (5120, "5 120"), (640.2, "640"), (185.4, "185"), (27.74, "27.7"), (8.46, "8.46"), (0.0812, "0.0812")],
)
def test_numbers_are_shown_with_three_digits(value: float, text: str) -> None:
    assert shown(value) == text


def test_shares_are_shown_in_percent() -> None:
    assert (percent(0.874), percent(0.0123), percent(None), percent(float("nan"))) == ("87.4 %", "1.23 %", "–", "–")
