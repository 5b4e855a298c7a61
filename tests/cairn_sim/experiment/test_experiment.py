"""`cairn experiment` as a user types it, small; its numbers are computed again from the cells that it wrote."""

import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
from tests.fixtures.map.made import KEY, MIDDLE, random_evidence
from tests.fixtures.sim.pages import read_page

from cairn_fusion.mapping.integrate import Integrator, Method, integrate_scans
from cairn_map.codec.cell_code import DecodedCell, encode_cell
from cairn_map.epochs.epoch import BASE
from cairn_map.errors import BadInputError
from cairn_map.evidence.evidence_map import EvidenceMap
from cairn_map.evidence.inverse_sensor_model import SensorModel
from cairn_map.files.cell_folder import read_cells, read_head
from cairn_sim.evaluation.scores import Scores, scores_of
from cairn_sim.evaluation.truth_grid import box_of_cell, truths_of
from cairn_sim.experiment.cells import measure_cells
from cairn_sim.experiment.command import main
from cairn_sim.experiment.pointer_octree import encode_pointer_octree, occupied_voxels
from cairn_sim.experiment.robots import recorded_robot, simulated_robots
from cairn_sim.robots.record import Plan, record
from cairn_sim.robots.robots import ROBOTS
from cairn_sim.scene.scene_file import load_scene, shipped_text

pytestmark = pytest.mark.slow

SHORT = ("--stops", "1", "--scale", "0.1", "--seed", "5")
SECONDS_MAX = 120
Json = dict[str, Any]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run: one stop of each of the two robots, at 8 and 4 cm."""
    output = tmp_path_factory.mktemp("experiment") / "out"
    assert main(["--resolutions", "4", "8", "--output", str(output), *SHORT]) == 0
    return output


@pytest.fixture(scope="module")
def report(folder: Path) -> Json:
    found: Json = json.loads((folder / "report.json").read_text())
    return found


def cells_of(folder: Path) -> list[DecodedCell]:
    cells = read_cells(folder, read_head(folder).layer)
    return [DecodedCell(cell.key, cell.layer.geometry, cell.history.rows[BASE], cell.digest) for cell in cells]


def of_resolutions(folder: Path, report: Json) -> Iterator[tuple[Json, list[DecodedCell]]]:
    assert [one["voxel_edge_m"] for one in report["resolutions"]] == [0.08, 0.04]
    for one, name in zip(report["resolutions"], ("map-8cm", "map-4cm"), strict=True):
        yield one, cells_of(folder / name)


def test_sizes_are_those_of_the_files(folder: Path, report: Json) -> None:
    for one, cells in of_resolutions(folder, report):
        assert len(cells) == one["derived"]["nonempty_cells"] > 10
        files = list((folder / f"map-{one['voxel_edge_m'] * 100:g}cm").glob("*.cell"))
        total = one["derived"]["codings"]["cairn, exact, fast"]
        assert total["map_bytes"] == sum(file.stat().st_size for file in files)
        assert total["mean_cell_bytes"] == pytest.approx(total["map_bytes"] / len(files))
        dense = 8 * round(5.12 / one["voxel_edge_m"]) ** 3
        assert one["derived"]["uncompressed_cube_bytes"] == dense
        assert total["ratio"] == pytest.approx(dense * len(files) / total["map_bytes"])


def test_fill_and_the_papers_octree_are_those_of_the_cells(folder: Path, report: Json) -> None:
    model = SensorModel()
    for one, cells in of_resolutions(folder, report):
        known, occupied = [], []
        for cell, told in zip(cells, one["cells"], strict=True):
            counts = cell.evidence.counts.astype(np.int64)
            log_odds = counts @ [math.log(0.7 / 0.3), math.log(0.4 / 0.6)]
            known.append(len(counts))
            occupied.append(int((log_odds > 0).sum()))
            octree = encode_pointer_octree(occupied_voxels(cell.key, cell.evidence, cell.geometry, model))
            assert told["coded"]["pointer octree, zip"]["size_bytes"] == len(octree)
        assert [told["known"] for told in one["cells"]] == known
        assert [told["occupied"] for told in one["cells"]] == occupied
        voxels = round(5.12 / one["voxel_edge_m"]) ** 3
        assert one["derived"]["filled_known"][2] == pytest.approx(median(known) / voxels)
        assert one["derived"]["filled_occupied"][4] == pytest.approx(max(occupied) / voxels)
        assert one["derived"]["cells_with_obstacles"] == sum(count > 0 for count in occupied)
        for told in one["cells"]:
            assert told["pack_s"] > 0 and told["unpack_s"] > 0
            assert all(coded["encode_s"] > 0 and coded["decode_s"] > 0 for coded in told["coded"].values())


def test_the_map_is_the_sum_of_all_scans(folder: Path, report: Json) -> None:
    scene, robot = load_scene("building"), ROBOTS["orpheus"]
    robots = simulated_robots(scene, robot, scale=0.1, seed=5, stops=1, threads=2)
    scans = [scan for one in reversed(robots) for scan in one.scans_at(0)]
    for one, cells in of_resolutions(folder, report):
        geometry = cells[0].geometry
        whole = integrate_scans(scans, robots[0].rig, geometry, integrator=Integrator(), threads=1)
        assert {cell.key: cell.evidence for cell in cells} == whole
        rays = sum(int(np.count_nonzero((scan.range_m >= 0.1) & (scan.range_m <= 10))) for scan in scans)
        assert sum(told["rays"] for told in one["measurements"]) == rays
        seconds = sum(told["integrate_s"] for told in one["measurements"])
        assert one["derived"]["images_per_s"] == pytest.approx(72 / seconds)


def test_scores_are_those_of_the_cells_against_the_truth(folder: Path, report: Json) -> None:
    scene, robot = load_scene("building"), ROBOTS["tof"]
    robots = simulated_robots(scene, robot, scale=1.0, seed=5, stops=1, threads=2)
    poses = [T for one in robots if one.truth for T in one.truth.T_map_cameras[::5]]
    camera = robots[0].rig["tof"].camera
    one, cells = next(of_resolutions(folder, report))
    boxes = [box_of_cell(cell.key, cell.geometry) for cell in cells]
    truths = truths_of(scene, boxes, camera=camera, T_map_cameras=poses, fineness=2)
    diff = {cell.key: cell.evidence for cell in cells}
    total = sum((scores_of(truth, diff, cells[0].geometry) for truth in truths), Scores())
    told = one["truth"]
    assert told["cells"] == len(cells) and told["poses"] == len(poses) == 16
    assert Scores(**told["scores"]) == total
    assert told["ratios"]["recall"] == pytest.approx(total.recall)
    assert 0.8 < total.recall < 1 and total.carved < 0.03 and total.precision > 0.95


def test_the_page_is_sound_and_has_the_papers_values(folder: Path, report: Json) -> None:
    page = read_page((folder / "report.html").read_text(encoding="utf-8"))
    # Thousands stand apart.
    words = {word.replace(" ", "") for word in page.words}
    for printed in ("16", "0.081", "640", "8.5", "1:75"):
        assert printed in page.words
    for one in report["resolutions"]:
        for total in one["derived"]["codings"].values():
            ratio = total["ratio"]
            assert f"1:{ratio:.0f}" in words or f"1:{ratio:.1f}" in words
    assert any(word.startswith("2 measurements of 2 robots, 72 scans") for word in page.words)
    pictures = [value for name, value in page.attributes if name == "href"]
    assert len(pictures) == 2 and all(len(value) > 5000 for value in pictures)


def test_nothing_but_maps_and_reports_is_left(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["map-4cm", "map-8cm", "report.html", "report.json"]


def test_a_folder_that_holds_something_is_refused(folder: Path) -> None:
    with pytest.raises(BadInputError, match="holds something already"):
        main(["--output", str(folder), *SHORT])
    with pytest.raises(BadInputError, match="cannot write"):
        main(["--output", "/proc/nowhere", *SHORT])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "room"
    scene, robot = load_scene("small-room"), replace(ROBOTS["orpheus"], scans=(4, 1))
    plan = Plan(scene=scene, robot=robot, path="west", seed=3, scale=0.1, truth="none", last_stop=2)
    assert len(list(record(plan, path, scene_text=shipped_text("small-room")))) == 8
    return path


def test_a_recording_is_mapped_and_compared_with_the_truth_beside_it(recording: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    assert main(["--recording", str(recording), "--resolutions", "8", "--output", str(output)]) == 0
    (one,) = json.loads((output / "report.json").read_text())["resolutions"]
    assert [(told["robot"], told["stop"], told["scans"]) for told in one["measurements"]] == [
        ("room", 0, 4),
        ("room", 1, 4),
    ]
    assert one["truth"]["ratios"]["recall"] > 0.5
    robot = recorded_robot(recording, stops=None)
    scans = [*robot.scans_at(0), *robot.scans_at(1)]
    cells = cells_of(output / "map-8cm")
    whole = integrate_scans(scans, robot.rig, cells[0].geometry, integrator=Integrator(method=Method.CARVE))
    assert {cell.key: cell.evidence for cell in cells} == whole


def test_a_recording_without_truth_has_no_scores(recording: Path, tmp_path: Path) -> None:
    bare, output = tmp_path / "bare", tmp_path / "out"
    shutil.copytree(recording, bare, ignore=shutil.ignore_patterns("truth"))
    assert main(["--recording", str(bare), str(recording), "--resolutions", "8", "--output", str(output)]) == 0
    (one,) = json.loads((output / "report.json").read_text())["resolutions"]
    assert one["truth"] is None and {told["robot"] for told in one["measurements"]} == {"bare", "room"}
    assert "is not known" in (output / "report.html").read_text(encoding="utf-8")
    with pytest.raises(BadInputError, match="must differ"):
        main(["--recording", str(bare), str(bare), "--output", str(tmp_path / "out2")])


def test_a_scene_made_by_a_program_has_no_truth_to_read(recording: Path, tmp_path: Path) -> None:
    made = tmp_path / "made"
    shutil.copytree(recording, made)
    assert recorded_robot(made, stops=1).truth is not None
    (made / "truth" / "scene.toml").write_text("# targets: made by a program, which has no file\n")
    assert recorded_robot(made, stops=1).truth is None


def test_cells_that_are_not_all_taken_leave_no_folder(tmp_path: Path) -> None:
    whole = EvidenceMap(MIDDLE)
    whole.merge({KEY: random_evidence(0, MIDDLE), type(KEY)(KEY + 1): random_evidence(1, MIDDLE)})
    with closing(measure_cells(whole, tmp_path / "map", model=SensorModel())) as cells:
        next(cells)
        assert [path.name for path in tmp_path.iterdir()] == ["map.part"]
    assert list(tmp_path.iterdir()) == []
    assert len(list(measure_cells(whole, tmp_path / "map", model=SensorModel()))) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
    first = cells_of(tmp_path / "map")[0]
    assert encode_cell(first.key, first.evidence, MIDDLE).digest == first.digest


@pytest.mark.processes
def test_an_interrupted_run_keeps_finished_resolutions_and_nothing_half(recording: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    command = [sys.executable, "-m", "cairn_client.main", "experiment", "--recording", str(recording)]
    with subprocess.Popen(
        # 2 cm takes 10 s more where all else takes 3.
        [*command, "--resolutions", "16", "2", "--output", str(output)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        for _ in range(SECONDS_MAX * 20):
            if (output / "report.html").exists():
                break
            try:
                process.wait(timeout=0.05)
            except subprocess.TimeoutExpired:
                continue
            break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=SECONDS_MAX)
    assert process.returncode == 130, err
    assert "has what was finished" in out
    assert sorted(path.name for path in output.iterdir()) == ["map-16cm", "report.html", "report.json"]
    report = json.loads((output / "report.json").read_text())
    assert report["asked"] == ["16 cm", "2 cm"] and len(report["resolutions"]) == 1
    assert "Not finished: 2 cm was" in (output / "report.html").read_text(encoding="utf-8")
    assert len(cells_of(output / "map-16cm")) == report["resolutions"][0]["derived"]["nonempty_cells"]


@pytest.mark.parametrize(
    "arguments", [["--stops", "0"], ["--threads", "x"], ["--robot", "nobody"], ["--resolutions", "nan"]]
)
def test_options_that_make_no_sense_are_refused(arguments: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        main([*arguments, "--output", str(tmp_path / "out")])


def test_a_voxel_edge_that_a_map_cannot_have_is_refused_before_the_drive(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="voxel edge"):
        main(["--resolutions", "0.01", "--output", str(tmp_path / "out"), *SHORT])
    assert not (tmp_path / "out").exists()
