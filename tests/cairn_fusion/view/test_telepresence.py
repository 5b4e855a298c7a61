"""Pictures for the operator: what is paint_over, hatched, marked and written; and the stream that browsers get."""

import math
import socket
import threading
import urllib.request
from dataclasses import replace
from urllib.error import HTTPError

import numpy as np
import numpy.typing as npt
import pytest

from cairn_calib.rig.poses import look_at
from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.view.mjpeg import Latest
from cairn_fusion.view.mjpeg_server import stream_pictures
from cairn_fusion.view.paint_kernels import HATCH_PERIOD, HATCH_WIDTH
from cairn_fusion.view.painting import (
    CROSS_PX,
    Emphasis,
    Hottest,
    draw_legend_into,
    enlarge,
    hottest,
    mark_hottest_into,
    paint_alone,
    paint_over,
)
from cairn_fusion.view.telepresence import Telepresence, ViewMode, ViewOptions, find_in, fuse
from cairn_fusion.view.temperature_scale import PALETTE, TemperatureScale, locked_scale
from cairn_map.errors import BadInputError
from cairn_sim.render.render import render_scan
from cairn_sim.robots.heads import RANGE_CAMERA, full_head, tof_head
from cairn_sim.scene.scene_file import load_scene

HEAD = full_head(scale=0.25)
SCALE = TemperatureScale(290.0, 310.0)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """A look at a warm person in the building."""
    scene = load_scene("building")
    torso = scene.solids[scene.number_of("technician/torso")].T_map_solid[:3, 3]
    T_map_rig = look_at(torso + np.array([-1.6, 0.3, 0.2]), torso)
    return render_scan(scene, HEAD, T_map_rig=T_map_rig, range_camera=RANGE_CAMERA, time_s=0.0)


def test_temperatures_are_blended_and_where_there_is_none_the_picture_is_hatched_never_cold() -> None:
    rng = np.random.default_rng(0)
    kelvin = rng.uniform(280, 320, (33, 40)).astype(np.float32)
    kelvin[3, 4] = np.nan
    labels = rng.choice([0, 0, 0, 1, 3, 4, 5], size=(33, 40)).astype(np.uint8)
    base = rng.integers(0, 256, (33, 40, 3)).astype(np.uint8)
    band = Emphasis(alpha=0.25, from_k=285.0, to_k=315.0)
    out = paint_over(base, kelvin, labels, SCALE, band)
    for y, x in np.ndindex(33, 40):
        grey = base[y, x].astype(int)
        if labels[y, x] != Label.OK or math.isnan(kelvin[y, x]):
            hatched = (x + y) % HATCH_PERIOD < HATCH_WIDTH
            expected = (grey + 150) // 2 if hatched else grey
        elif 285 <= kelvin[y, x] <= 315:
            level = int(np.clip((kelvin[y, x] - 290) * 255 / 20 + 0.5, 0, 255))
            expected = (grey * 192 + PALETTE[level].astype(int) * 64) >> 8
        else:
            expected = grey
        assert np.abs(out[y, x].astype(int) - expected).max() <= 1
    alone = paint_alone(kelvin, labels, SCALE)
    unknown = alone[labels != Label.OK]
    assert (unknown[:, :1] == unknown).all()  # greys; the palette's cold end is black, and not hatched


def test_the_hottest_is_a_square_and_not_one_noisy_pixel() -> None:
    kelvin, labels = np.full((20, 30), 295, np.float32), np.zeros((20, 30), np.uint8)
    kelvin[5:8, 20:23] = 310
    kelvin[15, 3] = 330
    kelvin[10:13, 10:13], labels[11, 11] = 400, Label.OCCLUDED
    found = hottest(kelvin, labels)
    assert found is not None
    assert (found.x, found.y) == (21, 6) and found.kelvin == pytest.approx(310)
    assert hottest(kelvin, np.full_like(labels, Label.NO_RANGE)) is None


def test_a_scale_is_locked_on_the_first_picture_and_a_given_one_stays(scan: Scan) -> None:
    look = Telepresence(HEAD, ViewOptions())
    assert look.scale is None
    look.view(scan)
    first = look.scale
    assert first is not None and first.note == "locked"
    hotter = {name: image + np.float32(50) for name, image in scan.thermal.items()}
    look.view(replace(scan, thermal=hotter))
    assert look.scale == first
    fixed = Telepresence(HEAD, ViewOptions(scale=SCALE))
    fixed.view(scan)
    assert fixed.scale == SCALE
    flat = locked_scale(np.full(100, 293.15))
    assert flat.low_k < 293.15 < flat.high_k and flat.high_k - flat.low_k >= 10
    with pytest.raises(BadInputError, match="no temperature"):
        locked_scale(np.array([np.nan]))
    with pytest.raises(BadInputError, match="lower to a higher"):
        TemperatureScale(300.0, 300.0)


@pytest.mark.parametrize(
    ("mode", "shape"),
    [
        (ViewMode.THERMAL_ON_COLOUR, (240, 320, 3)),
        (ViewMode.COLOUR_ON_THERMAL, (256, 320, 3)),
        (ViewMode.SIDE_BY_SIDE, (240, 640, 3)),
        (ViewMode.STEREO, (240, 640, 3)),
    ],
)
def test_every_mode_gives_its_picture(scan: Scan, mode: ViewMode, shape: tuple[int, ...]) -> None:
    picture = Telepresence(HEAD, ViewOptions(mode=mode)).view(scan)
    assert picture.shape == shape and picture.dtype == np.uint8
    if mode is ViewMode.SIDE_BY_SIDE:
        np.testing.assert_array_equal(picture[:, :320], scan.colour["colour_left"])
    if mode is ViewMode.STEREO:
        assert not np.array_equal(picture[:, :320], picture[:, 320:])


def test_a_small_picture_is_shown_larger_so_that_there_is_room_for_words(scan: Scan) -> None:
    rng = np.random.default_rng(0)
    for height, times in ((30, 8), (64, 4), (120, 2), (239, 2), (240, 1), (960, 1)):
        base = rng.integers(0, 256, (height, 10, 3)).astype(np.uint8)
        larger = enlarge(base)
        assert larger.shape == (times * height, times * 10, 3) and larger is not base
        np.testing.assert_array_equal(larger[times // 2 :: times, times // 2 :: times], base)


@pytest.mark.parametrize(("width", "height"), [(320, 240), (640, 480), (1280, 960)])
def test_the_hottest_places_label_leaves_the_legend_readable(width: int, height: int) -> None:
    """Wherever the place is; the cross itself may be on it."""
    alone = np.full((height, width, 3), 200, np.uint8)
    end = draw_legend_into(alone, SCALE)
    assert (alone[: end[1], end[0] + 3 :] == 200).all()
    for y in range(0, height, height // 24):
        marked = alone.copy()
        mark_hottest_into(marked, Hottest(0, y, 305.0), legend_end=end)
        same = (marked == alone).all(axis=2)[: end[1], : end[0]]
        same[max(y - CROSS_PX - 2, 0) : y + CROSS_PX + 3, : CROSS_PX + 3] = True
        assert same.all() and not np.array_equal(marked, alone)


def test_both_eyes_have_the_hottest_marked_at_the_same_place(scan: Scan) -> None:
    left, right = (fuse(scan, HEAD, name) for name in ("colour_left", "colour_right"))
    place = hottest(left.values[..., 0], left.labels)
    assert place is not None
    found = find_in(place, left, right, HEAD)
    assert found is not None and found.kelvin == place.kelvin
    points = []
    for name, each, at in (("colour_left", left, place), ("colour_right", right, found)):
        point = HEAD[name].camera.rays()[at.y, at.x] * float(each.depth.shown_m[at.y, at.x])
        points.append(HEAD[name].transform[:3, :3] @ point + HEAD[name].transform[:3, 3])
    assert np.linalg.norm(points[0] - points[1]) < 0.03 * float(left.depth.shown_m[place.y, place.x])
    hidden = replace(right, depth=replace(right.depth, shown_m=0.5 * right.depth.shown_m))
    assert find_in(place, left, hidden, HEAD) is None
    assert find_in(replace(place, x=319, y=239), left, right, HEAD) is None  # beyond its image


def test_only_what_is_hot_is_painted_when_asked(scan: Scan) -> None:
    fused = fuse(scan, HEAD, "colour_left")
    options = ViewOptions(emphasis=Emphasis(alpha=1.0, from_k=300.0), scale=SCALE, marks_hottest=False)
    picture = Telepresence(HEAD, options).view(scan)
    hot = fused.ok & (fused.values[..., 0] > 300)
    cold = fused.ok & ~hot
    cold[:140, :90] = hot[:140, :90] = False  # the legend
    base = scan.colour["colour_left"]
    np.testing.assert_array_equal(picture[cold], base[cold])
    assert hot.sum() > 500 and (picture[hot] != base[hot]).any(axis=1).mean() > 0.95


def test_without_a_thermal_image_all_is_hatched_and_said_so(scan: Scan) -> None:
    picture = Telepresence(HEAD, ViewOptions()).view(replace(scan, thermal={}))
    changed = (picture != scan.colour["colour_left"]).any(axis=2)
    assert 0.1 < changed.mean() < 0.4


def test_what_a_rig_or_scan_lacks_is_named(scan: Scan) -> None:
    with pytest.raises(BadInputError, match="needs 1 colour"):
        Telepresence(tof_head(), ViewOptions())
    with pytest.raises(BadInputError, match="colour_left, colour_right"):
        Telepresence(HEAD, ViewOptions(camera="thermal_left"))
    with pytest.raises(BadInputError, match="no image of 'colour_left'"):
        Telepresence(HEAD, ViewOptions()).view(replace(scan, colour={}))
    with pytest.raises(BadInputError, match="needs 2"):
        one = Rig(name="one", cameras={n: HEAD[n] for n in ("tof", "colour_left", "thermal_left")})
        Telepresence(one, ViewOptions(mode=ViewMode.STEREO))
    with pytest.raises(BadInputError, match="alpha"):
        Emphasis(alpha=1.5)


def picture(level: int) -> npt.NDArray[np.uint8]:
    return np.full((48, 64, 3), level, np.uint8)


def test_a_browser_gets_the_page_the_last_picture_and_each_new_one() -> None:
    latest = Latest()
    with stream_pictures(latest) as url:
        assert url.startswith("http://127.0.0.1:")
        with pytest.raises(HTTPError, match="503"):
            urllib.request.urlopen(url + "view.jpg", timeout=5)
        with pytest.raises(HTTPError, match="404"):
            urllib.request.urlopen(url + "other", timeout=5)
        latest.show(picture(10))
        assert b"/stream.mjpg" in urllib.request.urlopen(url, timeout=5).read()
        assert urllib.request.urlopen(url + "view.jpg", timeout=5).read() == latest.jpeg
        with urllib.request.urlopen(url + "stream.mjpg", timeout=5) as stream:
            assert "multipart/x-mixed-replace" in stream.headers["Content-Type"]
            for level in (10, 200):
                if level != 10:
                    latest.show(picture(level))
                head = b"".join(stream.readline() for _ in range(4))
                size = int(head.partition(b"Content-Length: ")[2].split(b"\r\n")[0])
                assert stream.read(size) == latest.jpeg
                assert stream.readline() == b"\r\n"


def test_more_viewers_than_allowed_are_told_to_come_later_and_one_that_goes_makes_room() -> None:
    latest = Latest()
    latest.show(picture(1))
    with stream_pictures(latest, clients_max=1) as url:
        with urllib.request.urlopen(url + "stream.mjpg", timeout=5) as stream:
            stream.readline()
            with pytest.raises(HTTPError, match="503"):
                urllib.request.urlopen(url + "stream.mjpg", timeout=5)
        gone = threading.Event()
        for level in range(200):
            latest.show(picture(level))
            try:
                urllib.request.urlopen(url + "stream.mjpg", timeout=5).close()
            except HTTPError:
                gone.wait(0.02)
                continue
            break
        else:
            pytest.fail("the place of a viewer that went away was never free again")


def test_an_address_that_is_taken_is_refused_in_words() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with (
            pytest.raises(BadInputError, match="cannot listen"),
            stream_pictures(Latest(), port=taken.getsockname()[1]),
        ):
            pass
