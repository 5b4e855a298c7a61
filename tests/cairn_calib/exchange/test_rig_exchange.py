"""Camera files of other programs: what is held comes back exactly, what is not is named, and OpenCV reads ours."""

import ast
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import yaml
from tests.fixtures.calib.foreign_rigs import KALIBR, ROS

from cairn_calib.cli.main import main
from cairn_calib.exchange.placed_camera import PlacedCamera
from cairn_calib.exchange.rig_exchange import FORMATS, cameras_of_rig, format_of_text
from cairn_calib.rig.camera import Camera
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.pose_vectors import transform_from_vector
from cairn_calib.rig.rig import RangeSensing, Rig, Spectrum, load_rig, mount_camera
from cairn_map.errors import BadInputError

# Numbers that no decimal of few digits is, and some that are written with an exponent.
BROWN5 = Camera(
    width=640,
    height=480,
    focal_px=(535.9157339616320, 1e3 / 3),
    centre_px=(1e-05, 235.5708),
    distortion=(-0.1, 1e-7, 0, 0),
)
BROWN = BROWN5.model_copy(update={"distortion": (-0.2663726090966068, 1e-17, 1.7e-3, -2.8e-4, 0.23839153080878486)})
RATIONAL = BROWN5.model_copy(update={"distortion": (0.4, 0.2, 1e-3, -5e-4, 0.05, 0.7, 0.15, 1 / 3)})
FISHEYE = FisheyeCamera(
    width=640, height=480, focal_px=(200.1, 201.2), centre_px=(320.3, 240.4), distortion=(0.1, -1e-05, 1e-3, -1e-4)
)
PLACES = [np.eye(4), transform_from_vector([0.1, 0.2, 0.3, 1, 2, 3]), transform_from_vector([-2, 1, 0.5, 0, 1e-05, -3])]
HELD = {"kalibr": [BROWN5, FISHEYE], "opencv": [BROWN, RATIONAL, FISHEYE], "mrcal": [BROWN, RATIONAL]}
HELD["ros"] = HELD["opencv"]


def rig_of(*cameras: Lens) -> Rig:
    names = ("tof", "left", "right")
    spectra = (Spectrum.RANGE, Spectrum.COLOUR, Spectrum.THERMAL)
    every = zip(names, spectra, cameras, PLACES, strict=False)
    return Rig(name="head", cameras={name: mount_camera(spectrum, camera, T) for name, spectrum, camera, T in every})


def assert_same(found: PlacedCamera, name: str, camera: Lens, T: npt.NDArray[np.float64] | None) -> None:
    assert (found.name, found.camera) == (name, camera)
    if T is not None:
        assert found.T_rig_camera is not None
        np.testing.assert_allclose(found.T_rig_camera, T, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", HELD)
def test_what_a_format_holds_comes_back_exactly(name: str) -> None:
    each = FORMATS[name]
    for camera in HELD[name]:
        for T in PLACES[1:] if name in ("opencv", "mrcal") else PLACES[:1]:
            text = each.write([PlacedCamera("left", camera, T if each.holds_place else None)])
            assert format_of_text(Path("left.cameramodel" if name == "mrcal" else "left.yaml"), text) == name
            back = each.read(text, name="left.yaml")
            assert_same(back.cameras[0], "left", camera, T if each.holds_place else None)


def test_a_camchain_keeps_names_order_and_places() -> None:
    given = [PlacedCamera(name, BROWN5, T) for name, T in zip(("tof", "left", "right"), PLACES, strict=True)]
    back = FORMATS["kalibr"].read(FORMATS["kalibr"].write(given), name="camchain.yaml")
    for found, each in zip(back.cameras, given, strict=True):
        assert_same(found, each.name, BROWN5, each.T_rig_camera)
    assert back.left_out == ()


@pytest.mark.parametrize("name", ["kalibr", "ros"])
def test_a_small_number_is_a_number_to_every_yaml_reader(name: str) -> None:
    document = yaml.safe_load(FORMATS[name].write([PlacedCamera("left", BROWN5, None)]))
    found = document["cam0"]["intrinsics"][2] if name == "kalibr" else document["camera_matrix"]["data"][2]
    assert (type(found), found) == (float, 1e-05)


def test_opencv_reads_what_is_written_for_it_to_the_last_bit(tmp_path: Path) -> None:
    (tmp_path / "left.yml").write_text(FORMATS["opencv"].write([PlacedCamera("left", RATIONAL, PLACES[1])]))
    storage = cv2.FileStorage(str(tmp_path / "left.yml"), cv2.FILE_STORAGE_READ)
    (fx, fy), (cx, cy) = RATIONAL.focal_px, RATIONAL.centre_px
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    np.testing.assert_array_equal(storage.getNode("distortion_coefficients").mat()[:, 0], RATIONAL.distortion)
    point_rig = np.array([0.3, 0.2, 5.0])
    R, T = storage.getNode("R").mat(), storage.getNode("T").mat()[:, 0]
    np.testing.assert_allclose(PLACES[1] @ [*(R @ point_rig + T), 1], [*point_rig, 1], atol=1e-14)


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "left.yml"), cv2.FILE_STORAGE_WRITE)
    (fx, fy), (cx, cy) = BROWN.focal_px, BROWN.centre_px
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array(BROWN.distortion)[:, None])
    storage.write("avg_reprojection_error", 0.4)
    storage.release()
    written = (tmp_path / "left.yml").read_text()
    for text in (
        written,
        written.replace("%YAML 1.2", "%YAML:1.0"),
        written.replace("%YAML 1.2\n---\n", "%YAML:1.0\n"),
    ):
        back = FORMATS["opencv"].read(text, name="left.yml")
        assert_same(back.cameras[0], "left", BROWN, None)
        assert back.left_out == ("avg_reprojection_error",)


def test_a_cameramodel_is_a_dictionary_that_places_the_camera_from_the_reference() -> None:
    document = ast.literal_eval(FORMATS["mrcal"].write([PlacedCamera("left", RATIONAL, PLACES[2])]))
    assert document["lensmodel"] == "LENSMODEL_OPENCV8"
    assert document["intrinsics"] == [*RATIONAL.focal_px, *RATIONAL.centre_px, *RATIONAL.distortion]
    assert document["imagersize"] == [640, 480]
    point_ref = np.array([0.3, 0.2, 5.0])
    r, t = np.array(document["extrinsics"][:3]), np.array(document["extrinsics"][3:])
    point_camera = cv2.Rodrigues(r)[0] @ point_ref + t
    np.testing.assert_allclose(PLACES[2] @ [*point_camera, 1], [*point_ref, 1], atol=1e-12)
    # As its authors' files have it: a comment, trailing commas, more than a rig holds.
    theirs = """# generated
{ 'lensmodel':  'LENSMODEL_OPENCV4', 'intrinsics': [ 2073.872915, 2077.4, 3004.6, 1997.3, 0.4, 0.02, 4e-05, -1e-05,],
      'valid_intrinsics_region': [[ 622, 0 ],], 'extrinsics': [ 0, 0, 0, 0, 0, 0,], 'imagersize': [ 6016, 4016,],
      'optimization_inputs': b'P)h>@6aWAK', }"""
    back = FORMATS["mrcal"].read(theirs, name="cam.cameramodel")
    assert back.cameras[0].camera.distortion == (0.4, 0.02, 4e-05, -1e-05, 0)
    assert back.left_out == ("valid_intrinsics_region", "optimization_inputs")


def test_files_as_others_write_them_are_read() -> None:
    kalibr = FORMATS["kalibr"].read(KALIBR, name="camchain.yaml")
    assert (kalibr.cameras[0].name, kalibr.left_out) == ("cam0", ("cam0.T_cam_imu",))
    assert kalibr.cameras[0].camera.distortion == (0.27, 0.69, -1.7, 1e-5)
    ros = FORMATS["ros"].read(ROS, name="x.yaml")
    assert (ros.cameras[0].name, ros.left_out) == ("mono", ("rectification_matrix",))


@pytest.mark.parametrize(
    ("name", "text", "named"),
    [
        ("kalibr", KALIBR.replace("pinhole", "omni"), "cam0: the lens is omnidirectional .Mei.*--models pinhole-equi"),
        ("kalibr", KALIBR.replace("equidistant", "fov"), "cam0: the lens is FOV .*solve --fisheye"),
        ("kalibr", KALIBR.replace("pinhole", "eucm"), "the lens is extended unified .EUCM"),
        ("kalibr", KALIBR.replace("pinhole", "ds"), "the lens is double sphere .'ds' in the file"),
        ("kalibr", KALIBR.replace("  camera_model: pinhole\n", ""), "cam0: camera_model is missing"),
        ("opencv", "%YAML:1.0\n---\nxi: 1.2\n", "the lens is omnidirectional"),
        ("kalibr", KALIBR.replace(", 1e-5]", "]"), "distortion_coeffs of equidistant are 4, got 3"),
        (
            "kalibr",
            KALIBR + KALIBR[10:].replace("cam0", "cam1").replace("T_cam_imu", "T_base"),
            "cam1.T_cn_cnm1 is missing",
        ),
        ("kalibr", KALIBR.replace("cam0", "cam1"), "without a gap"),
        ("ros", ROS.replace("plumb_bob", "fov"), "distortion_model: the lens is FOV"),
        ("ros", ROS.replace("[500, 0, 320", "[500, 3, 320"), "camera_matrix .* no skew, got 3"),
        ("ros", ROS.replace("0.1, 0, 0, 0, 0", "0.1, 0, 0"), "distortion_coefficients: .*1 x 5 numbers, got 3"),
        ("ros", ROS.replace("500", ".nan"), "focal_px"),
        (
            "ros",
            ROS.replace("cols: 5", "cols: 12").replace("0.1, 0, 0", "0.1, 0, 0, 0, 0, 0, 0, 0, 0, 1e-3"),
            "thin prism",
        ),
        ("ros", ROS.replace("mono", "../up"), "a camera's name must be letters.*up"),
        ("ros", "a: [" * 5000, "nested too deep|no YAML"),
        ("ros", "- 1", "mapping"),
        ("ros", "a: !!python/object/apply:os.system [ls]", "no YAML"),
        ("opencv", "%YAML:1.0\nM1: 3\n", "image_width"),
        ("kalibr", "%YAML 1.0\n---\ncam0: 3\n", "cam0"),
        ("ros", "image_width: !!float\n", "is no YAML"),
        ("ros", "image_width: !!int x\n", "is no YAML"),
        ("ros", "image_width: 3\nimage_width: 4\n", "duplicate key"),
        ("mrcal", "{'lensmodel': 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3'", "not a Python dictionary"),
        ("mrcal", "[" * 10_000, "not a Python dictionary"),
        (
            "mrcal",
            "{'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [1]*4, 'extrinsics': [0]*6, 'imagersize': [1, 1]}",
            "not a Python dictionary",
        ),
        (
            "mrcal",
            str(
                {"lensmodel": "LENSMODEL_OPENCV12", "intrinsics": [1] * 16, "extrinsics": [0] * 6, "imagersize": [1, 1]}
            ),
            "thin prism",
        ),
        (
            "mrcal",
            "{'lensmodel': 'CAHVOR', 'intrinsics': [1,1,1,1], 'extrinsics': [0,0,0,0,0,0], 'imagersize': [1, 1]}",
            "lensmodel must be .*mrcal-convert-lensmodel",
        ),
    ],
)
def test_what_cannot_be_read_is_named(name: str, text: str, named: str) -> None:
    with pytest.raises(BadInputError, match=named):
        FORMATS[name].read(text, name="x.yaml")


@pytest.mark.parametrize("head", ["", "%YAML 1.0\n---\n", "%YAML 1.1\n---\n", "%YAML:1.0\n---\n", "%YAML 1.2\n---\n"])
def test_a_small_number_without_a_point_is_read_as_one(head: str) -> None:
    given = FORMATS["ros"].write([PlacedCamera("left", BROWN5, None)])
    text = head + given.removeprefix("%YAML 1.1\n---\n").replace("1.0e-05", "1e-05")
    assert "1e-05" in text
    assert FORMATS["ros"].read(text, name="left.yaml").cameras[0].camera == BROWN5


def test_what_cannot_be_written_is_named() -> None:
    with pytest.raises(BadInputError, match=r"cameras.tof.camera.distortion: .*k3 = 0.238392"):
        FORMATS["kalibr"].write(cameras_of_rig(rig_of(BROWN), format_name="kalibr").cameras)
    with pytest.raises(BadInputError, match=r"cameras.tof.camera.model: mrcal has no Kannala-Brandt"):
        FORMATS["mrcal"].write(cameras_of_rig(rig_of(FISHEYE), format_name="mrcal").cameras)
    with pytest.raises(BadInputError, match=r"cameras.left.T_rig_camera: .*put the gauge first"):
        FORMATS["kalibr"].write(cameras_of_rig(rig_of(BROWN5, BROWN5), format_name="kalibr").cameras[::-1])
    with pytest.raises(BadInputError, match=r"holds one camera, the rig has tof, left"):
        FORMATS["opencv"].write(cameras_of_rig(rig_of(BROWN, BROWN), format_name="opencv").cameras)


def test_what_a_rig_says_besides_must_be_dropped_by_name() -> None:
    rig = rig_of(BROWN, RATIONAL)
    tof = rig["tof"].model_copy(update={"sensing": RangeSensing(no_return_clears_m=5)})
    rig = rig.model_copy(update={"cameras": {**rig.cameras, "tof": tof}})
    with pytest.raises(BadInputError, match=r"cameras.tof.sensing, cameras.left.T_rig_camera; .* --drop sensing,T_rig"):
        cameras_of_rig(rig, format_name="ros")
    kept = cameras_of_rig(rig, format_name="ros", drop=["sensing", "T_rig_camera"])
    assert [each.T_rig_camera for each in kept.cameras] == [None, None]
    assert kept.left_out[:2] == ("cameras.tof.sensing", "cameras.left.T_rig_camera")


def test_the_command_goes_there_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, at = rig_of(BROWN5, FISHEYE, BROWN5), str(tmp_path)
    (tmp_path / "rig.json").write_bytes(rig.to_json())
    spectra = "tof=range,left=colour,right=thermal"
    assert main(["convert", f"{at}/rig.json", f"{at}/chain.yaml", "--format", "kalibr"]) == 0
    assert "chain.yaml: tof, left, right\n" in capsys.readouterr().out
    main(["convert", f"{at}/chain.yaml", f"{at}/again.json", "--spectrum", spectra, "--name", "head"])
    main(["convert", f"{at}/rig.json", f"{at}/{{camera}}.yml", "--format", "opencv"])
    parts = [f"{at}/{name}.yml" for name in rig.cameras]
    main(["convert", *parts, f"{at}/parts.json", "--spectrum", spectra, "--name", "head"])
    for name in ("again", "parts"):
        back = load_rig(tmp_path / f"{name}.json")
        assert (back.name, list(back.cameras)) == ("head", ["tof", "left", "right"])
        for camera in rig.cameras:
            assert (back[camera].spectrum, back[camera].camera) == (rig[camera].spectrum, rig[camera].camera)
            np.testing.assert_allclose(back[camera].transform, rig[camera].transform, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["rig.json", "out.yaml"], "add --format"),
        (["rig.json", "out.json"], "a rig.json already"),
        (["rig.json", "out.cameramodel", "--camera", "up"], "no camera 'up'; it has tof, left"),
        (["rig.json", "out.cameramodel"], "{camera} in OUT"),
        (["rig.json", "out.yaml", "--format", "ros", "--drop", "distortion"], "--drop takes T_rig_camera"),
        (["left.yaml", "out.json"], "add --spectrum mono=colour"),
        (["left.yaml", "out.json", "--spectrum", "x-ray"], "range, colour, thermal, got 'x-ray'"),
        (["left.yaml", "out.json", "--spectrum", "right=colour"], "no camera 'right'; there are mono"),
        (["left.yaml", "left.yaml", "out.json", "--spectrum", "colour"], "two cameras have one name: mono, mono"),
        (["missing.yaml", "out.json"], "cannot read .*missing.yaml"),
        (["other.yaml", "out.json"], "other.yaml is of no known format"),
    ],
)
def test_the_command_says_what_to_do(arguments: list[str], named: str, tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_bytes(rig_of(BROWN, RATIONAL).to_json())
    (tmp_path / "left.yaml").write_text(ROS)
    (tmp_path / "other.yaml").write_text("a: 1\n")
    with pytest.raises(BadInputError, match=named):
        main(["convert", *(f"{tmp_path}/{each}" if "." in each else each for each in arguments)])
