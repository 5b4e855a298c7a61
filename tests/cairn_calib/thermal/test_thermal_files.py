"""FLIR's real files, maps of pixels, and `cairn calib thermal`."""

import os
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.fixtures.calib.thermal_images import RESPONSE, SIZE, black_bodies, images, scene

from cairn_calib.cli.main import main
from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.radiometry import PlanckResponse
from cairn_calib.rig.rig import Rig, Spectrum, load_rig, mount_camera
from cairn_calib.thermal.flat_field import FlatField, fit_flat_field, read_flat_field, write_flat_field
from cairn_calib.thermal.flir_file import read_flir
from cairn_calib.thermal.object_temperature import Temperatures, temperatures
from cairn_map.errors import BadInputError, DamagedDataError


@pytest.fixture(scope="module")
def flir() -> Path:
    data = os.environ.get("CAIRN_TEST_DATA")
    if not data:
        pytest.skip("CAIRN_TEST_DATA names no folder of real recordings")
    return Path(data) / "flir_radiometric"


@pytest.mark.recording
@pytest.mark.parametrize(
    ("name", "size", "celsius"),
    [
        ("FLIR.jpg", (320, 240), (25.9, 62.3)),
        ("FLIR_AX8.jpg", (60, 80), (24.4, 25.5)),
        ("FLIR_E40.jpg", (120, 160), (17.9, 24.7)),
    ],
)
def test_real_files_have_the_temperatures_that_another_program_reads(
    flir: Path, name: str, size: tuple[int, int], celsius: tuple[float, float]
) -> None:
    image = read_flir(flir / name)
    found = temperatures(image.counts, image.radiometry, viewing=image.viewing)
    assert isinstance(found, Temperatures) and found.kelvin.shape == size
    # Printed to 0.1 K by flyr, which takes the air for a little thicker.
    assert (found.kelvin.min() - 273.15, found.kelvin.max() - 273.15) == pytest.approx(celsius, abs=0.11)
    assert found.sigma_k.min() >= 1.0


@pytest.mark.recording
def test_numbers_in_a_real_file_are_those_that_exiftool_prints(flir: Path) -> None:
    said = (flir / "FLIR.txt").read_text(encoding="utf-16")
    printed = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in said.splitlines())}
    image = read_flir(flir / "FLIR.jpg")
    response = image.radiometry.response
    assert isinstance(response, PlanckResponse)
    assert response.r == pytest.approx(float(printed["Planck R1"]) / float(printed["Planck R2"]), rel=1e-6)
    assert (response.b_k, response.f) == pytest.approx((float(printed["Planck B"]), float(printed["Planck F"])))
    assert response.o == -float(printed["Planck O"])
    assert image.viewing.emissivity == pytest.approx(float(printed["Emissivity"]))
    assert image.viewing.reflected_k - 273.15 == pytest.approx(20.0, abs=1e-3)
    assert [k - 273.15 for k in image.radiometry.range_k] == pytest.approx([-40.0, 120.0], abs=1e-3)


@pytest.mark.recording
def test_damaged_and_plain_pictures_are_refused(flir: Path, tmp_path: Path) -> None:
    data, rng = (flir / "FLIR_AX8.jpg").read_bytes(), np.random.default_rng(2)
    path = tmp_path / "x.jpg"
    for cut in (0, 1, 100, 3000, 20_000):
        path.write_bytes(data[:cut])
        with pytest.raises((DamagedDataError, BadInputError)):
            read_flir(path)
    for _ in range(200):
        bent = bytearray(data)
        for at in rng.integers(0, 12_000, 20):
            bent[at] = rng.integers(0, 256)
        path.write_bytes(bent)
        with suppress(DamagedDataError, BadInputError):
            read_flir(path)
    cv2.imwrite(str(path), np.zeros((9, 9), np.uint8))
    with pytest.raises(BadInputError, match="not radiometric"):
        read_flir(path)


def test_maps_level_the_pixels_of_images_that_they_were_not_made_of() -> None:
    rng = np.random.default_rng(7)
    true = scene(rng)
    fitted = fit_flat_field([images(true, level, 16, rng) for level in (4000.0, 5000.0, 6500.0)])
    assert (fitted.flat_field.bad == true.bad).all()
    assert fitted.noise_counts == pytest.approx(2.0, rel=0.05)
    level = fitted.flat_field.level_counts(images(true, 5600.0, 1, rng, noise=0.0)[0])
    assert np.isnan(level[true.bad]).all()
    # 60 counts before; the maps' own noise is 2 / sqrt(16), smaller between two of their levels.
    assert np.std(level[~true.bad]) < 0.6 and np.nanmean(level) == pytest.approx(5600.0, abs=6)
    assert fitted.pattern_counts == pytest.approx(0.5, rel=0.15)


def test_shading_is_the_smooth_part_and_outlives_the_shutter() -> None:
    rng = np.random.default_rng(8)
    true = scene(rng, bad=0)
    fitted = fit_flat_field([images(true, level, 32, rng) for level in (4000.0, 6000.0)]).flat_field
    assert np.std(fitted.shading - true.shading) < 2.5
    # The camera warmed up: offsets are others. Its shutter, behind the lens, sees no shading.
    warm = FlatField(true.gain, (10 * rng.standard_normal(SIZE)).astype(np.float32), true.shading, true.bad)
    behind = FlatField(warm.gain, warm.offset, np.zeros_like(warm.shading), warm.bad)
    again = fitted.after_shutter(images(behind, 5000.0, 1, rng, noise=0.0)[0])
    now = images(warm, 5200.0, 1, rng, noise=0.0)[0]
    assert np.std(fitted.level_counts(now)) > 10
    assert np.std(again.level_counts(now)) < 3


def test_one_temperature_gives_offsets_and_no_gain() -> None:
    rng = np.random.default_rng(9)
    true = scene(rng, bad=0)
    fitted = fit_flat_field([images(true, 5000.0, 8, rng)])
    assert (fitted.flat_field.gain == 1).all()
    assert np.std(fitted.flat_field.level_counts(images(true, 5000.0, 1, rng, noise=0)[0])) < 1.0
    with pytest.raises(BadInputError, match="two images or more"):
        fit_flat_field([images(true, 5000.0, 1, rng)])


def test_maps_come_back_from_their_file_and_another_file_is_refused(tmp_path: Path) -> None:
    true = scene(np.random.default_rng(1))
    named = write_flat_field(tmp_path / "a.maps.npz", true)
    back = read_flat_field(tmp_path / "a.maps.npz", named)
    for name in ("gain", "offset", "shading", "bad"):
        np.testing.assert_array_equal(getattr(back, name), getattr(true, name))
    (tmp_path / "a.maps.npz").write_bytes(b"PK")
    with pytest.raises(BadInputError, match="SHA-256 differs"):
        read_flat_field(tmp_path / "a.maps.npz", named)
    with pytest.raises(BadInputError, match="the maps are of"):
        back.level_counts(np.zeros((4, 4)))


def test_the_command_goes_from_black_bodies_to_temperatures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = black_bodies(tmp_path, np.random.default_rng(3), celsius=(10.0, 35.0, 60.0, 90.0))
    rig = Rig(
        name="head",
        cameras={"t": mount_camera(Spectrum.THERMAL, camera_from_field_of_view(128, 96, horizontal_deg=60), np.eye(4))},
    )
    (tmp_path / "rig.json").write_bytes(rig.to_json())
    out = tmp_path / "done.json"
    assert main(["thermal", "fit", str(table), str(out), "--rig", str(tmp_path / "rig.json"), "--camera", "t"]) == 0
    told = capsys.readouterr().out
    assert "planck law from 4 temperatures, 10.0 to 90.0 C" in told and "5 bad" in told
    known = load_rig(out)["t"].radiometry
    assert known is not None and known.maps is not None
    assert known.response.kelvin_of(RESPONSE.counts_of(320.0)) == pytest.approx(320.0, abs=0.3)
    kelvin = tmp_path / "kelvin.png"
    options = ["--rig", str(out), "--camera", "t", "--output", str(kelvin), "--picture", str(tmp_path / "look.png")]
    assert main(["thermal", "read", str(tmp_path / "b35-0.png"), *options]) == 0
    assert "median 35.0 C +- 0." in capsys.readouterr().out
    centi = np.asarray(cv2.imread(str(kelvin), cv2.IMREAD_UNCHANGED))
    assert (centi == 0).sum() == 5 and np.median(centi[centi > 0]) == pytest.approx(30815, abs=15)
    assert main(["thermal", "read", str(tmp_path / "b35-0.png")]) == 0
    assert "not radiometric" in capsys.readouterr().out
    with pytest.raises(BadInputError, match="no temperatures to write"):
        main(["thermal", "read", str(tmp_path / "b35-0.png"), "--output", str(kelvin)])


def test_the_command_names_what_is_wrong_with_a_table(tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    for text, message in (
        ("image, celsius\n", "no column sigma_k"),
        ("image, celsius, sigma_k\na.png, warm, 0.1\n", "line 2"),
        ("image, celsius, sigma_k\n", "two temperatures"),
        ("image, celsius, sigma_k\na.png, 10, 0.1\n", "cannot read"),
    ):
        table.write_text(text)
        with pytest.raises(BadInputError, match=message):
            main(["thermal", "fit", str(table), str(tmp_path / "o.json")])
    with pytest.raises(BadInputError, match="go together"):
        main(["thermal", "fit", str(table), str(tmp_path / "o.json"), "--camera", "x"])
    assert not (tmp_path / "o.json").exists()
