"""Range and amplitude images of boards from files: what shows a range camera's bias."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from cairn_calib.rig.calibration import InputFile
from cairn_calib.rig.image_files import Grey, read_grey
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.board_views import BoardViews, RangeView, frame_of
from cairn_calib.solve.solve_plan import SolvePlan
from cairn_map.errors import BadInputError


def with_ranges(
    views: BoardViews, plan: SolvePlan, folder: Path, units_per_m: float, *, amplitudes: Path | None = None
) -> BoardViews:
    """The views with the 16-bit range images of a folder, of the first range camera, and their amplitudes' images.

    They count as inputs, with their digests, after the corner documents.

    Args:
        views: of the boards.
        plan: names the range camera.
        folder: of range images, radial; 0 where nothing came back. They belong to frames as corner images do.
        units_per_m: of their counts.
        amplitudes: a folder of images of the same frames; None: the amplitudes are not known.

    Raises:
        BadInputError: there is no range camera, or no image, or one that cannot be read, or two are of one frame.
    """
    owner = next((name for name, camera in plan.cameras.items() if camera.spectrum is Spectrum.RANGE), None)
    if owner is None or not units_per_m > 0:
        raise BadInputError("bad_arguments", "--range needs a camera of spectrum range, and units per metre above 0")
    bright = {} if amplitudes is None else _by_frame(amplitudes, "amplitude")
    inputs: list[InputFile] = []
    ranges = []
    for frame, path in _by_frame(folder, "range").items():
        counts = _read(path, "range", inputs)
        amplitude = _read(bright[frame], "amplitude", inputs).astype(np.uint16) if frame in bright else None
        ranges.append(RangeView(owner, frame, np.where(counts > 0, counts / units_per_m, np.nan), amplitude))
    return replace(views, ranges=tuple(ranges), inputs=(*views.inputs, *inputs))


def _by_frame(folder: Path, what: str) -> dict[str, Path]:
    paths: dict[str, Path] = {}
    for path in sorted(folder.glob("*.png")):
        other = paths.setdefault(frame_of(path.stem), path)
        if other != path:
            raise BadInputError(
                "bad_arguments", f"{other} and {path} are {what} images of one frame: the last number in their names"
            )
    if not paths:
        raise BadInputError("bad_arguments", f"{folder} holds no {what} images (*.png)")
    return paths


def _read(path: Path, what: str, inputs: list[InputFile]) -> Grey:
    """(H, W) counts; its digest joins the inputs."""
    counts, data = read_grey(path)
    digest = hashlib.sha256(data).hexdigest()
    inputs.append(InputFile(name=f"{what}/{path.name}"[:200], size_bytes=len(data), sha256=digest))
    return counts
