"""Views of one board by the cameras of a rig, with range images if there are any: the input of a calibration.

    frame "03":   tof/03.json   left/03.json   ...        one frame = one place of the board, seen by some cameras
    frame "04":   tof/04.json                  ...

Images belong to one frame by their names: `frame_pairing.py` says how.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.board.board import Board, Polarity
from cairn_calib.board.corner_file import CornerFile, read_corner_file
from cairn_calib.board.corners import Corners
from cairn_calib.board.frame_pairing import frames_of, pairing_table, refuse_unpaired
from cairn_calib.rig.calibration import InputFile
from cairn_calib.rig.image_files import Grey, read_grey
from cairn_calib.rig.rig import Spectrum
from cairn_calib.solve.solve_plan import SolvePlan
from cairn_map.errors import BadInputError

KIND = "bad_board_views"
DISC_RATIO = 1.03
"""Ratio of the diameters of one board's discs, as two cameras saw them, at most."""
SEEN_MIN = 6
"""Points of a board in one image; with fewer its pose is hardly more than noise."""


@dataclass(frozen=True, slots=True)
class BoardView:
    """One camera's image of one frame; `image` names it to a person."""

    camera: str
    frame: str
    image: str
    corners: Corners


@dataclass(frozen=True, slots=True)
class RangeView:
    """The range image of one frame: (H, W) metres along the beam or, of z-depth, along the optical axis.

    NaN where nothing came back.
    """

    camera: str
    frame: str
    range_m: npt.NDArray[np.floating]
    amplitude: npt.NDArray[np.integer] | None = None
    """(H, W) counts of the light that came back; 0: unknown, 65535: too much."""
    is_z_depth: bool = False


@dataclass(frozen=True, slots=True)
class BoardViews:
    """All views of one board by the cameras of one rig."""

    board: Board
    sizes_px: Mapping[str, tuple[int, int]]
    """Width and height of the images of each camera, by name, in the rig's order."""
    views: tuple[BoardView, ...]
    ranges: tuple[RangeView, ...] = ()
    inputs: tuple[InputFile, ...] = ()
    polarities: Mapping[str, Polarity] | None = None
    """Polarity with which each camera's corners were found; for the report only."""

    def __post_init__(self) -> None:
        if len({(view.camera, view.frame) for view in self.views}) < len(self.views):
            raise BadInputError(KIND, "a camera has two images of one frame")
        named = {view.camera for view in self.views} | {each.camera for each in self.ranges}
        if strangers := named - set(self.sizes_px):
            raise BadInputError(KIND, f"views of unknown cameras: {', '.join(sorted(strangers))}")

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names, in the rig's order."""
        return tuple(self.sizes_px)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames that any camera saw, sorted."""
        return tuple(sorted({view.frame for view in self.views}))

    def of_camera(self, name: str) -> tuple[BoardView, ...]:
        """The views of one camera, by frame."""
        return tuple(sorted((view for view in self.views if view.camera == name), key=lambda view: view.frame))

    def refuse_unpaired(self) -> None:
        """Check that frames connect all cameras that saw the board, and still do without any one of them.

        Raises:
            BadInputError: they do not.
        """
        refuse_unpaired({name: own for name, own in self._frames_by_camera().items() if own}, self._examples())

    def pairing_table(self) -> str:
        """Lines that show which frames each camera saw, and how many of them two cameras share."""
        return pairing_table(self._frames_by_camera(), self._examples())

    def _frames_by_camera(self) -> dict[str, list[str]]:
        return {name: [view.frame for view in self.of_camera(name)] for name in self.cameras}

    def _examples(self) -> dict[str, str]:
        return {view.camera: f"{view.image} is {view.frame}" for view in reversed(self.views)}

    def alone(self, name: str) -> "BoardViews":
        """The views of one camera, as if it were the rig."""
        ranges = tuple(each for each in self.ranges if each.camera == name)
        return replace(self, sizes_px={name: self.sizes_px[name]}, views=self.of_camera(name), ranges=ranges)

    def of_frames(self, frames: Iterable[str]) -> "BoardViews":
        """The views of some frames, with all cameras."""
        kept = set(frames)
        return replace(
            self,
            views=tuple(view for view in self.views if view.frame in kept),
            ranges=tuple(each for each in self.ranges if each.frame in kept),
        )

    def without(self, views: Iterable[tuple[str, str]]) -> "BoardViews":
        """All but some views, by camera and frame."""
        left_out = set(views)
        return replace(self, views=tuple(view for view in self.views if (view.camera, view.frame) not in left_out))


def read_board_views(folders: Mapping[str, Path], *, frame: str | None = None) -> BoardViews:
    """The views in folders of corner documents (`cairn calib corners`), by camera name.

    Documents without corners count as inputs, not as views; so do those with fewer than 6. `frame` is the pattern of
    `frames_of`.

    Raises:
        BadInputError: no documents, two with corners of one frame, of two boards, or of two sizes.
        DamagedDataError: a document is not of that format.
    """
    sizes: dict[str, tuple[int, int]] = {}
    views: list[BoardView] = []
    inputs: list[InputFile] = []
    polarities: dict[str, Polarity] = {}
    boards: dict[Board, Path] = {}
    for camera, folder in folders.items():
        # A camera is a folder: one polarity, one image size.
        documents = _documents(folder)
        inputs += [_input_file(camera, path) for path, _ in documents]
        polarities[camera] = _one_polarity(folder, [document for _, document in documents])
        sizes[camera] = _one_size(camera, [document for _, document in documents])
        used: dict[str, Path] = {}
        names = frames_of([path.stem for path, _ in documents], frame)
        for (path, document), name in zip(documents, names, strict=True):
            boards.setdefault(_without_small_difference(document.board, boards), path)
            # Images without a board are inputs, but no views.
            corners = document.to_corners()
            if corners is None or corners.seen.sum() < SEEN_MIN:
                continue
            # One image of a frame for each camera.
            if name in used:
                raise BadInputError(
                    KIND,
                    f"{used[name]} and {path} are of one frame, {name}: say with --frame REGEX which part of a name "
                    "counts the places of the board",
                )
            used[name] = path
            views.append(BoardView(camera, name, document.image, corners))
    if len(boards) > 1:
        first, other = list(boards.values())[:2]
        raise BadInputError(KIND, f"{first} and {other} are of two boards: one calibration needs one board")
    return BoardViews(next(iter(boards)), sizes, tuple(views), inputs=tuple(inputs), polarities=polarities)


def _without_small_difference(board: Board, others: Iterable[Board]) -> Board:
    """The board, or an equal one among others whose discs' diameter, seen by another camera, differs a little."""
    for other in others:
        if board.disc_m and other.disc_m and 1 / DISC_RATIO < board.disc_m / other.disc_m < DISC_RATIO:
            alike = board.model_copy(update={"disc_m": other.disc_m})
            if alike == other:
                return other
    return board


def _documents(folder: Path) -> list[tuple[Path, CornerFile]]:
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise BadInputError(KIND, f"{folder} holds no corner documents (*.json): make them with cairn calib corners")
    return [(path, read_corner_file(path)) for path in paths]


def _one_polarity(folder: Path, documents: Sequence[CornerFile]) -> Polarity:
    """Polarity of a camera; the first corner of a chessboard that is not known to be upright depends on it."""
    named = {each.polarity for each in documents if each.corners and each.board.pattern == "chessboard"}
    if len(named) > 1 and not all(each.upright for each in documents):
        raise BadInputError(
            KIND,
            f"the documents in {folder} do not agree whether dark or bright is printed, since their run was cut, or "
            "there were several: run cairn calib corners for all images of this camera with --resume",
        )
    return documents[0].polarity


def _one_size(camera: str, documents: Iterable[CornerFile]) -> tuple[int, int]:
    sizes = sorted({(each.width, each.height) for each in documents if each.width and each.height})
    if len(sizes) > 1:
        told = " and ".join(f"{width} x {height}" for width, height in sizes)
        raise BadInputError(KIND, f"images of {camera} are of several sizes, {told}: one camera has one")
    if not sizes:
        raise BadInputError(KIND, f"no image of {camera} could be read: its documents say why")
    return sizes[0]


def _input_file(camera: str, path: Path) -> InputFile:
    data = path.read_bytes()
    return InputFile(name=f"{camera}/{path.name}"[:200], size_bytes=len(data), sha256=hashlib.sha256(data).hexdigest())


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeCoding:
    """Meaning of the counts of a range image; 0 is no return.

    range or z-depth: counts / units metres; disparity: z-depth = focal_px baseline_m / (counts / units).
    """

    units: float = 1000.0
    """Counts a metre; of disparity, counts a pixel."""
    is_z_depth: bool = False
    """True if metres are along the optical axis, not along the beam."""
    disparity: tuple[float, float] | None = None
    """Focal length of the rectified images, pixels, and baseline, metres; None: no disparity."""

    def __post_init__(self) -> None:
        numbers = (self.units, *(self.disparity or ()))
        if not all(np.isfinite(each) and each > 0 for each in numbers):
            raise BadInputError("bad_arguments", f"units, focal length and baseline are above 0, got {numbers}")

    @property
    def is_along_axis(self) -> bool:
        """True if what the counts give is z-depth."""
        return self.is_z_depth or self.disparity is not None

    def metres(self, counts: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """(H, W) metres of (H, W) counts; NaN for 0."""
        known = np.where(counts > 0, counts, np.nan).astype(np.float64) / self.units
        return known if self.disparity is None else self.disparity[0] * self.disparity[1] / known


def add_ranges(
    views: BoardViews,
    plan: SolvePlan,
    folder: Path,
    coding: RangeCoding,
    *,
    amplitudes: Path | None = None,
    frame: str | None = None,
) -> BoardViews:
    """Add the 16-bit range images of a folder, of the first range camera, and their amplitude images, to the views.

    They count as inputs, with their digests, after the corner documents.

    Args:
        views: views of the boards.
        plan: names the range camera.
        folder: range images, pixel by pixel those of the camera's corners. They belong to frames as corner images do.
        coding: meaning of their counts.
        amplitudes: a folder of images of the same frames; None: the amplitudes are unknown.
        frame: the pattern of `frames_of`.

    Raises:
        BadInputError: there is no range camera, or no image, or one that cannot be read, or two are of one frame.
    """
    # Ranges belong to the first range camera of the plan.
    owner = next((name for name, camera in plan.cameras.items() if camera.spectrum is Spectrum.RANGE), None)
    if owner is None:
        raise BadInputError("bad_arguments", "--range needs a camera of spectrum range")
    if coding.is_along_axis and plan.cameras[owner].model != "pinhole":
        raise BadInputError("bad_arguments", f"{owner} is a fisheye, which has no z-depth: its images hold range")
    bright = {} if amplitudes is None else _by_frame(amplitudes, "amplitude", frame)
    inputs: list[InputFile] = []
    ranges = []
    for name, path in _by_frame(folder, "range", frame).items():
        counts = _read(path, "range", inputs)
        amplitude = _read(bright[name], "amplitude", inputs).astype(np.uint16) if name in bright else None
        ranges.append(RangeView(owner, name, coding.metres(counts), amplitude, coding.is_along_axis))
    return replace(views, ranges=tuple(ranges), inputs=(*views.inputs, *inputs))


def _by_frame(folder: Path, what: str, frame: str | None) -> dict[str, Path]:
    images = sorted(folder.glob("*.png"))
    if not images:
        raise BadInputError("bad_arguments", f"{folder} holds no {what} images (*.png)")
    paths: dict[str, Path] = {}
    for path, name in zip(images, frames_of([path.stem for path in images], frame), strict=True):
        other = paths.setdefault(name, path)
        if other != path:
            raise BadInputError("bad_arguments", f"{other} and {path} are {what} images of one frame, {name}")
    return paths


def _read(path: Path, what: str, inputs: list[InputFile]) -> Grey:
    """(H, W) counts; its digest joins the inputs."""
    counts, data = read_grey(path)
    digest = hashlib.sha256(data).hexdigest()
    inputs.append(InputFile(name=f"{what}/{path.name}"[:200], size_bytes=len(data), sha256=digest))
    return counts
