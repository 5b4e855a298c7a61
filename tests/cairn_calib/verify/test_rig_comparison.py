"""Comparison of two calibrations: the same agrees, noise agrees as often as stated, a shock does not."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.calib.simulated_views import COLOUR, PLACES, THERMAL, TOF
from tests.fixtures.lengths import length

from cairn_calib.cli.main import main
from cairn_calib.rig.calibration import Calibration, covariance_from_matrix
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_calib.verify.rig_comparison import PixelComparison, compare_rigs
from cairn_map.errors import BadInputError

SIGMAS = np.array([0.4, 0.4, 0.5, 0.5, 1e-3, 2e-3, 1e-4, 1e-4, 2e-3])
"""Standard deviations of fx, fy, cx, cy (px), k1, k2, p1, p2, k3."""
SHIFTS = np.array([2e-4, 2e-4, 3e-4, 5e-4, 5e-4, 1e-3])
"""Standard deviations of a camera's place: rotation vector (rad) and translation (m)."""


def covariances(seed: int = 0) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Parameters of two cameras, and a covariance with correlations, as solves have them."""
    names = [(camera, name) for camera in ("tof", "left") for name in COLOUR.intrinsic_names]
    names += [("left", name) for name in ("rx", "ry", "rz", "tx", "ty", "tz")]
    sigmas = np.concatenate([0.1 * SIGMAS, SIGMAS, SHIFTS])  # a tenth: a range camera has large pixels
    rng = np.random.default_rng(seed)
    loose = rng.normal(size=(len(sigmas), len(sigmas)))
    correlation = 0.5 * np.eye(len(sigmas)) + 0.5 * np.corrcoef(loose)
    return names, correlation * np.outer(sigmas, sigmas)


def rig_with(errors: np.ndarray | None = None, *, scale: float = 1.0) -> Rig:
    """A rig whose numbers are off by these errors of its parameters, and that states their covariance."""
    names, covariance = covariances()
    off = np.zeros(len(names)) if errors is None else errors
    lenses = [
        camera.with_intrinsics(camera.intrinsics + off[start : start + 9]) for camera, start in ((TOF, 0), (COLOUR, 9))
    ]
    T = transform_from_vector(PLACES["left"])
    turn = transform_from_vector([*off[18:21], 0, 0, 0])
    T[:3, :3], T[:3, 3] = turn[:3, :3] @ T[:3, :3], T[:3, 3] + off[21:]
    cameras = {
        "tof": mount_camera(Spectrum.RANGE, Camera.model_validate(lenses[0].model_dump()), np.eye(4)),
        "left": mount_camera(Spectrum.COLOUR, Camera.model_validate(lenses[1].model_dump()), T),
    }
    known = Calibration(
        software="test", made_s=0, gauge="tof", covariance=covariance_from_matrix(names, scale**2 * covariance)
    )
    return Rig(name="head", cameras=cameras, calibration=known)


BOTH = [("tof", "tof"), ("left", "left")]


def test_a_rig_agrees_with_itself() -> None:
    for each in compare_rigs(rig_with(), rig_with(), BOTH, (2.0, np.inf)):
        assert each.rms_px < 1e-9
        assert each.agrees is True
        assert each.expected_px is not None and each.expected_px > 0.01


def test_a_turned_camera_with_a_shifted_principal_point_is_the_same_camera() -> None:
    """A thin pinhole that is turned by a little sees the same, but for the second order."""
    flat = Camera(width=640, height=480, focal_px=(4000.0, 4000.0), centre_px=(319.5, 239.5))
    shifted = flat.model_copy(update={"centre_px": (329.5, 234.5)})
    a, b = (Rig(name="r", cameras={"c": mount_camera(Spectrum.COLOUR, each, np.eye(4))}) for each in (flat, shifted))
    (found,) = compare_rigs(a, b, [("c", "c")], (np.inf,))
    assert found.rms_px < 0.05
    turned_rad = np.arccos((np.trace(found.T_b_a[:3, :3]) - 1) / 2)
    assert turned_rad == pytest.approx(np.hypot(10, 5) / 4000, rel=1e-3)
    assert found.agrees is None and found.sigma_px is None


@pytest.mark.parametrize("range_m", [2.0, np.inf])
def test_calibrations_with_the_stated_noise_agree_as_often_as_stated_and_no_more(range_m: float) -> None:
    names, covariance = covariances()
    rng, root = np.random.default_rng(5), np.linalg.cholesky(covariance)
    scores: dict[tuple[str, str | None], list[PixelComparison]] = {}
    for _ in range(length(30, long=80)):
        a, b = (rig_with(root @ rng.normal(size=len(names))) for _ in range(2))
        for each in compare_rigs(a, b, BOTH, (range_m,)):
            scores.setdefault((each.camera, each.source), []).append(each)
    assert len(scores) == 3
    for found in scores.values():
        assert np.mean([each.score for each in found]) == pytest.approx(1.0, abs=0.3)
        measured = np.sqrt(np.mean([each.rms_px**2 for each in found]))
        assert measured == pytest.approx(float(found[0].expected_px or 0), rel=0.25)
        assert sum(each.agrees is False for each in found) <= length(1, long=2)


def test_half_the_noise_that_there_is_is_not_believed() -> None:
    names, covariance = covariances()
    rng, root = np.random.default_rng(5), np.linalg.cholesky(covariance)
    a, b = (rig_with(root @ rng.normal(size=len(names)), scale=0.2) for _ in range(2))
    assert any(each.agrees is False for each in compare_rigs(a, b, BOTH, (2.0,)))


def test_a_shock_that_turned_a_camera_shows_between_cameras_and_in_no_lens() -> None:
    names, _ = covariances()
    off = np.zeros(len(names))
    off[names.index(("left", "ry"))] = 0.005
    found = compare_rigs(rig_with(), rig_with(off), BOTH, (2.0, np.inf))
    assert [each.agrees for each in found if each.source is None] == [True] * 4
    carried = [each for each in found if each.source == "tof"]
    assert [each.agrees for each in carried] == [False, False]
    # A turn to the right by 5 mrad at 1330 px focal length: points move to the left by 6.65 px.
    assert np.nanmedian(carried[1].difference_px[..., 0]) == pytest.approx(-6.65, rel=0.1)


def test_a_lens_of_another_model_that_sees_the_same_agrees() -> None:
    """Brown's eight coefficients with the last three at 0 are those with five."""
    wide = COLOUR.model_copy(update={"distortion": (*COLOUR.distortion, 0.0, 0.0, 0.0)})
    a, b = (Rig(name="r", cameras={"c": mount_camera(Spectrum.COLOUR, each, np.eye(4))}) for each in (COLOUR, wide))
    assert compare_rigs(a, b, [("c", "c")], (np.inf,))[0].rms_px < 1e-9


def test_the_command_says_whether_they_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names, _ = covariances()
    off = np.zeros(len(names))
    off[names.index(("left", "tx"))] = 0.02
    for name, rig in (("march", rig_with()), ("april", rig_with()), ("shock", rig_with(off))):
        (tmp_path / f"{name}.json").write_bytes(rig.to_json())
    march, april, shock = (str(tmp_path / f"{name}.json") for name in ("march", "april", "shock"))
    report = tmp_path / "compared.html"
    main(["compare", march, april])
    assert "march.json and april.json agree within their stated uncertainty" in capsys.readouterr().out
    main(["compare", march, shock, "--report", str(report)])
    told = capsys.readouterr().out
    assert "do not agree within their stated uncertainty" in told and "(tof to left, 2 m)" in told
    document = json.loads(report.with_suffix(".json").read_text())
    assert document["agrees"] is False and document["sentence"] in told
    kinds = [(each["camera"], each["source"], each["range_m"], each["agrees"]) for each in document["comparisons"]]
    assert kinds == [
        *(("tof", None, 2, True), ("tof", None, None, True), ("left", None, 2, True), ("left", None, None, True)),
        *(("left", "tof", 2, False), ("left", "tof", None, True)),
    ]
    page = report.read_text()
    assert "do not agree within their stated uncertainty" in page and page.count("<svg") == 18
    main(["convert", march, str(tmp_path / "left.cameramodel"), "--camera", "left", "--drop", "calibration"])
    main(["compare", march, str(tmp_path / "left.cameramodel"), "--at", "inf"])
    told = capsys.readouterr().out
    assert "whether march.json and left.cameramodel agree cannot be said" in told and "0.000 px rms" in told


def test_what_cannot_be_compared_says_why(tmp_path: Path) -> None:
    other = Rig(name="r", cameras={"left": mount_camera(Spectrum.THERMAL, THERMAL, np.eye(4))})
    (tmp_path / "a.json").write_bytes(rig_with().to_json())
    (tmp_path / "b.json").write_bytes(other.to_json())
    a, b = str(tmp_path / "a.json"), str(tmp_path / "b.json")
    with pytest.raises(BadInputError, match=r"left has images of 1280 x 960 pixels in one .* of 640 x 512"):
        main(["compare", a, b])
    renamed = json.loads((tmp_path / "b.json").read_text())
    renamed["cameras"] = {"front": renamed["cameras"]["left"]}
    (tmp_path / "c.json").write_text(json.dumps(renamed))
    with pytest.raises(BadInputError, match="no camera has one name in both: tof, left, and front"):
        main(["compare", a, str(tmp_path / "c.json")])
    with pytest.raises(BadInputError, match="there is no camera 'up'; there are tof, left"):
        main(["compare", a, b, "--camera", "up"])
    with pytest.raises(BadInputError, match="--at is metres"):
        main(["compare", a, b, "--at", "near"])
    with pytest.raises(BadInputError, match="name the report otherwise"):
        main(["compare", a, a, "--report", str(tmp_path / "a.html")])
