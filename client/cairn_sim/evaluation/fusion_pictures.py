"""Pictures of how true fused images are: the paper's Fig. 24, and where a fused image is wrong.

fig24.png      colour, thermal, fused without calibration, fused with it
errors.png     the fused image, what each pixel is labelled, the error of temperature
"""

import numpy as np

from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_fusion.image_fusion.cross_view import CrossView
from cairn_fusion.recording.scan import Scan
from cairn_fusion.transfer.transfer import Label
from cairn_fusion.view.painting import Emphasis, draw_legend_into, paint_alone, paint_over, write_into
from cairn_fusion.view.telepresence import fuse
from cairn_fusion.view.temperature_scale import TemperatureScale
from cairn_map.arrays import Rgb
from cairn_sim.evaluation.fusion_truth import FusionTruth
from cairn_sim.robots.heads import full_head

LABEL_COLOURS = {
    Label.OK: (40, 60, 80),
    Label.OCCLUDED: (230, 60, 50),
    Label.OUT_OF_VIEW: (120, 120, 120),
    Label.NO_RANGE: (10, 10, 10),
    Label.SATURATED: (250, 220, 60),
    Label.FLYING: (200, 80, 220),
    Label.NO_READING: (255, 255, 255),
    Label.UNCERTAIN: (80, 200, 220),
    Label.BEYOND: (60, 160, 90),
}
GAP_PX = 8
"""Between the panels of a figure."""
ERROR_SPAN_K = 5.0
"""At which an error is as bright as it gets."""


def uncalibrated(rig: Rig) -> Rig:
    """A head as its data sheets have it: fields of view and pixel counts, all cameras at one place, straight ahead."""
    ideal, here = full_head(ideal=True), np.eye(4)
    cameras = {}
    for name, each in rig.cameras.items():
        lens = ideal[name].camera
        scale = each.camera.width / lens.width
        focal, centre = lens.focal_px[0] * scale, ((each.camera.width - 1) / 2, (each.camera.height - 1) / 2)
        same = each.camera.model_copy(
            update={"focal_px": (focal, focal), "centre_px": centre, "distortion": (0.0, 0.0, 0.0, 0.0, 0.0)}
        )
        cameras[name] = mount_camera(each.spectrum, same, here)
    return Rig(name=f"{rig.name}-nominal", cameras=cameras)


def figure_24(scan: Scan, rig: Rig, camera: str, scale: TemperatureScale) -> Rgb:
    """Colour, thermal, fused without calibration, and with it, as in Fig. 24 of the paper.

    (2 H + GAP_PX, 2 W + GAP_PX, 3), each with its name at its lower edge.

    Args:
        scan: to show.
        rig: the calibrated one.
        camera: a colour camera, to look through.
        scale: of the temperatures.
    """
    base, half = scan.colour[camera], Emphasis(alpha=0.55)
    thermal = rig.of_spectrum(Spectrum.THERMAL)[0]
    kelvin = scan.thermal[thermal]
    warm = paint_alone(kelvin, np.where(np.isfinite(kelvin), Label.OK, Label.NO_READING).astype(np.uint8), scale)
    fused = {
        "fused, not calibrated": fuse(scan, uncalibrated(rig), camera),
        "fused, calibrated": fuse(scan, rig, camera),
    }
    panels = {"colour": base.copy(), "thermal": _fitted(warm, base.shape[0], base.shape[1])}
    for name, each in fused.items():
        panels[f"{name}; hatched: no temperature"] = paint_over(base, each.values[..., 0], each.labels, scale, half)
    (H, W), out = base.shape[:2], np.full((2 * base.shape[0] + GAP_PX, 2 * base.shape[1] + GAP_PX, 3), 255, np.uint8)
    for n, (name, panel) in enumerate(panels.items()):
        if n:
            draw_legend_into(panel, scale)
        write_into(panel, name, (14, H - 14))
        top, left = (n // 2) * (H + GAP_PX), (n % 2) * (W + GAP_PX)
        out[top : top + H, left : left + W] = panel
    return out


def error_picture(scan: Scan, fused: CrossView, truth: FusionTruth, scale: TemperatureScale) -> Rgb:
    """(H, 3 W, 3) the fused image; labels by colour; the error from black, none, to white, 5 K; hatched if unknown."""
    kelvin = fused.values[..., 0]
    picture = paint_over(scan.colour[fused.camera], kelvin, fused.labels, scale, Emphasis())
    draw_legend_into(picture, scale)
    labels = np.zeros_like(picture)
    for label, ink in LABEL_COLOURS.items():
        labels[fused.labels == label] = ink
    for n, label in enumerate(LABEL_COLOURS):
        write_into(labels, label.name.lower().replace("_", " "), (34, 30 + 26 * n))
        labels[14 + 26 * n : 30 + 26 * n, 10:28] = LABEL_COLOURS[label]
    error = np.abs(kelvin - truth.values[..., 0])
    wrong = paint_alone(error, fused.labels, TemperatureScale(0.0, ERROR_SPAN_K))
    write_into(wrong, f"error, 0 to {ERROR_SPAN_K:g} K", (10, 30))
    return np.hstack([picture, labels, wrong])


def _fitted(picture: Rgb, height: int, width: int) -> Rgb:
    """A picture in the middle of a dark one of another size, as large as it fits, nearest pixels."""
    share = min(height / picture.shape[0], width / picture.shape[1])
    rows, columns = round(picture.shape[0] * share), round(picture.shape[1] * share)
    y = (np.arange(rows) / share).astype(np.int64).clip(0, picture.shape[0] - 1)
    x = (np.arange(columns) / share).astype(np.int64).clip(0, picture.shape[1] - 1)
    out = np.full((height, width, 3), 24, np.uint8)
    top, left = (height - rows) // 2, (width - columns) // 2
    out[top : top + rows, left : left + columns] = picture[y[:, None], x[None, :]]
    return out
