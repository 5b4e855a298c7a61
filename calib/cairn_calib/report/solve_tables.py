"""Tables of a calibration's report: estimates with standard deviations, and the residuals of each image."""

from collections.abc import Sequence

import numpy as np

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.diagnosis.view_statistics import ViewResiduals
from cairn_calib.report.page import Marked, Table
from cairn_calib.rig.calibration import PIXEL_NAMES, Statistics
from cairn_calib.solve.solve_plan import SHARED


def plus_minus(value: float, sigma: float, *, factor: float = 1.0) -> str:
    """`532.50 ± 0.21`: two digits of the standard deviation, and as many of the value."""
    value, sigma = factor * value, factor * sigma
    if not sigma > 0:
        return f"{value:.6g}"
    places = max(0, 1 - int(np.floor(np.log10(sigma))))
    # + 0.0: no "-0".
    return f"{round(value, places) + 0.0:.{places}f} ± {sigma:.{places}f}"


def statistics_table(statistics: Statistics) -> Table:
    """Images, corners and noise of each camera."""
    rows = [
        [
            name,
            str(each.images),
            str(each.points),
            str(each.outliers),
            f"{each.rms_px:.3f}",
            f"{each.sigma_px:.3f}",
        ]
        for name, each in statistics.cameras.items()
    ]
    return Table(["camera", "images", "corners", "left out", "rms, px", "noise, px"], rows)


def lens_table(seen: Examination) -> Table:
    """Intrinsics with standard deviations."""
    solution = seen.solution
    sigmas = solution.sigmas()
    names = list(dict.fromkeys(name for lens in solution.state.lenses for name in lens.intrinsic_names))
    cameras = list(solution.plan.cameras)
    values = {
        (camera, name): value
        for camera, lens in zip(cameras, solution.state.lenses, strict=True)
        for name, value in zip(lens.intrinsic_names, lens.intrinsics.tolist(), strict=True)
    }
    rows = []
    for name in names:
        cells: list[str | Marked] = [name + (", px" if name in PIXEL_NAMES else "")]
        for camera in cameras:
            if (camera, name) in sigmas:
                cells.append(plus_minus(values[camera, name], sigmas[camera, name]))
            else:
                known = (camera, name) in values
                cells.append(Marked("", f"{values[camera, name]:g} held", "held") if known else "")
        rows.append(cells)
    return Table(["", *cameras], rows)


def place_table(seen: Examination) -> Table:
    """Poses of the cameras in the gauge camera's frame, millimetres and degrees, with standard deviations."""
    solution = seen.solution
    sigmas = solution.sigmas()
    rows = []
    for camera, T in zip(solution.plan.cameras, solution.state.T_rig_camera, strict=True):
        if camera == solution.plan.gauge:
            rows.append([camera, "0", "0", "0", "0", "the rig's frame"])
            continue
        turn = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        at = [plus_minus(T[n, 3], sigmas[camera, name], factor=1000) for n, name in enumerate(("tx", "ty", "tz"))]
        spread = ", ".join(f"{np.degrees(sigmas[camera, name]):.3f}" for name in ("rx", "ry", "rz"))
        rows.append([camera, *at, f"{turn:.3f}", spread])
    head = ["camera", "x, mm", "y, mm", "z, mm", "turned by, degrees", "sigma about x, y, z, degrees"]
    return Table(head, rows)


def board_table(seen: Examination) -> Table:
    """Estimated shape and size of the board; no rows where both were held."""
    values, sigmas = seen.solution.values(), seen.solution.sigmas()
    rows = []
    for name, text in (("warp_x", "bent along x, mm"), ("warp_y", "bent along y, mm")):
        if (SHARED, name) in sigmas:
            rows.append([text, plus_minus(values[SHARED, name], sigmas[SHARED, name], factor=1000)])
    if (SHARED, "scale") in sigmas:
        rows.append(["pitch over the stated one", plus_minus(values[SHARED, "scale"], sigmas[SHARED, "scale"])])
    return Table(["", "estimate"], rows)


def image_table(residuals: Sequence[ViewResiduals], cameras: Sequence[str], frames: Sequence[str]) -> Table:
    """Residuals of each image: rms in pixels, and the number of corners that were left out."""
    found = {(each.camera, each.frame): each for each in residuals}
    rows = []
    for frame in frames:
        cells: list[str | Marked] = [frame]
        for camera in cameras:
            view = found.get((camera, frame))
            out = 0 if view is None else view.outliers
            rms = "" if view is None else f"{view.rms_px:.3f}"
            cells.append(Marked(rms, f"{out} out", "out") if out else rms)
        rows.append(cells)
    return Table(["frame", *cameras], rows)
