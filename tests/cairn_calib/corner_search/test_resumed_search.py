"""Runs over many images: written one by one, resumed where they were cut, the same bytes by any number of processes."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.board_images import BOARD, DISCS, THERMAL, TOF, picture, pose, truth

from cairn_calib.board.corner_file import read_corner_file
from cairn_calib.cli import corners as command
from cairn_calib.corner_search import image_search, search_workers
from cairn_calib.corner_search.image_search import BoardSearch, ImageTask, SearchedImage, search_image
from cairn_calib.solve.board_views import read_board_views
from cairn_map.errors import BadInputError

OPTIONS = ["--board", "9x6", "--square", "0.05", "--jobs", "1", "--output"]


def shots(folder: Path) -> list[str]:
    """Five images of a camera that sees dark as bright, the third without a board, the fifth without a margin."""
    folder.mkdir()
    rng = np.random.default_rng(8)
    paths = []
    for n in range(5):
        T = pose(rng, THERMAL)
        image = np.asarray(picture(THERMAL, T, rng))
        if n == 2:
            image = rng.integers(21900, 22100, image.shape).astype(np.uint16)
        if n == 4:
            at = truth(THERMAL, T)
            (x, y), (right, bottom) = np.clip(at.min(axis=0) - 8, 0, None).astype(int), (at.max(axis=0) + 8).astype(int)
            image = image[y:bottom, x:right]
        paths.append(folder / f"t{n}.png")
        cv2.imwrite(str(paths[-1]), image)
    return [str(path) for path in paths]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
def test_a_run_that_is_cut_leaves_whole_documents_and_resumes_to_the_bytes_of_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    images, whole, cut = shots(tmp_path / "shots"), tmp_path / "whole", tmp_path / "cut"
    assert command.main([*images, *OPTIONS, str(whole)]) == 0

    def cut_after_three(tasks: Sequence[ImageTask], *, jobs: int) -> Iterator[SearchedImage]:
        yield from search_workers.search_images(tasks[:3], jobs=jobs)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(command, "search_images", cut_after_three)
        with pytest.raises(KeyboardInterrupt):
            command.main([*images, *OPTIONS, str(cut)])
    assert "stopped after 3 of 5 images; the same command with --resume goes on" in capsys.readouterr().err
    assert sorted(contents(cut)) == [f"t{n}.{suffix}" for n in range(3) for suffix in ("json", "png")]
    assert len(read_board_views({"thermal": cut}).views) == 2
    searched: list[str] = []
    find = image_search.chessboard_candidates

    def counted(*given: object, **options: object) -> object:
        searched.append("one")
        return find(*given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(image_search, "chessboard_candidates", counted)
    assert command.main([*images, *OPTIONS, str(cut), "--resume"]) == 0
    assert len(searched) == 2
    assert "resumed: 3 of 5 images were done" in capsys.readouterr().err
    assert contents(cut) == contents(whole)
    assert command.main([*images, *OPTIONS, str(cut), "--resume"]) == 0
    assert len(searched) == 2
    assert contents(cut) == contents(whole)


@pytest.mark.slow
def test_resuming_searches_again_what_is_of_another_image_board_or_naming(tmp_path: Path) -> None:
    (first, *_) = shots(tmp_path / "shots")
    out = tmp_path / "out"
    assert command.main([first, *OPTIONS, str(out)]) == 0
    document = out / "t0.json"
    path, same = Path(first), BoardSearch(BOARD)

    def is_kept(search: BoardSearch, **more: object) -> bool:
        return search_image(ImageTask(path, search, document=document, **more)).is_kept  # type: ignore[arg-type]

    assert is_kept(same)
    assert not is_kept(BoardSearch(BOARD, upright=True))
    assert not is_kept(BoardSearch(BOARD, polarity="normal"))
    assert not is_kept(BoardSearch(BOARD.model_copy(update={"pitch_m": 0.06})))
    assert not is_kept(same, pointed=np.zeros((4, 2)))
    path.write_bytes((tmp_path / "shots" / "t1.png").read_bytes())
    assert not is_kept(same)
    document.write_text(document.read_text()[:-9])
    assert not is_kept(same)


@pytest.mark.processes
def test_any_number_of_processes_writes_the_same_bytes(tmp_path: Path) -> None:
    images = shots(tmp_path / "shots")
    written = []
    for jobs in ("1", "2", "3"):
        out = tmp_path / jobs
        assert command.main([*images, *OPTIONS[:-2], jobs, "--output", str(out)]) == 0
        written.append(contents(out))
    assert len(written[0]) == 10
    assert written[1] == written[0]
    assert written[2] == written[0]


def test_documents_that_disagree_on_the_first_corner_are_refused_until_the_run_is_finished(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    for name in ("a1", "b2"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture(TOF, pose(rng, TOF), rng))
    out = tmp_path / "out"
    for name, polarity in (("a1", "normal"), ("b2", "reversed")):
        assert command.main([str(tmp_path / f"{name}.png"), *OPTIONS, str(out), "--polarity", polarity]) == 0
    with pytest.raises(BadInputError, match="--resume"):
        read_board_views({"tof": out})
    assert command.main([str(tmp_path / "a1.png"), str(tmp_path / "b2.png"), *OPTIONS, str(out), "--resume"]) == 0
    assert len(read_board_views({"tof": out}).views) == 2


def test_discs_are_searched_again_under_the_polarity_that_all_images_settled(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    images = []
    for n in range(2):
        image = picture(TOF, pose(rng, TOF, board=DISCS, tilt_deg=30), rng, board=DISCS)
        images.append(tmp_path / f"{n}.png")
        cv2.imwrite(str(images[-1]), 20000 - image if n == 0 else rng.integers(0, 60000, image.shape).astype(np.uint16))
    options = ["--board", "4x11", "--square", "0.05", "--pattern", "asymmetric-circles", "--disc", "0.03"]
    assert command.main([*map(str, images), *options, "--output", str(tmp_path / "out")]) == 0
    for n in range(2):
        document = read_corner_file(tmp_path / "out" / f"{n}.json")
        assert document.polarity == "reversed"
        stated = BoardSearch(document.board, polarity="reversed")
        assert document.attempts == search_image(ImageTask(images[n], stated)).document.attempts


def test_an_image_that_breaks_the_search_does_not_end_that_of_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(4)
    for name in ("good", "ugly"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture(TOF, pose(rng, TOF), rng))
    find = image_search.chessboard_candidates
    calls: list[int] = []

    def break_first(*given: object, **options: object) -> object:
        calls.append(1)
        if len(calls) == 1:
            raise np.linalg.LinAlgError("singular matrix")
        return find(*given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(image_search, "chessboard_candidates", break_first)
    images = [str(tmp_path / f"{name}.png") for name in ("ugly", "good")]
    assert command.main([*images, *OPTIONS, str(tmp_path / "out")]) == 0
    failed = read_corner_file(tmp_path / "out" / "ugly.json").attempts[-1]
    assert (failed.stage, failed.reason) == ("failed", "LinAlgError: singular matrix")
    assert read_corner_file(tmp_path / "out" / "good.json").corners
