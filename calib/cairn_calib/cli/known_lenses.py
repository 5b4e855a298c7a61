"""Options `--prior` and `--hold`: what was known of the cameras before the images, from files and data sheets.

    --hold left=rig.json            the lens of that file, exactly; --hold rig.json: of all cameras with its names
    --hold left.k3=0                one number
    --prior left=rig.json           with the covariance that the file states
    --prior left=factory.yaml+-0.5  whose pixels are off by 0.5 px (root mean square over the image, one axis)
    --prior left.fx=1330+-5         one number and its standard deviation
    --prior left.tx=0.1+-0.001      of the camera's place: tx, ty, tz in metres, and rx, ry, rz in radians, the rotation
                                    vector of T_rig_camera: ry=0.26 looks 15 degrees to the right

A file is rig.json or any that `cairn calib convert` reads. It may have the camera under another name: `FILE#cam0`.
"""

import argparse
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cairn_calib.diagnosis.probe_points import image_grid
from cairn_calib.exchange.rig_exchange import RIG, format_of_text, read_cameras, read_text
from cairn_calib.rig.calibration import POSE_UNITS
from cairn_calib.rig.fisheye import FisheyeCamera
from cairn_calib.rig.lens import Lens
from cairn_calib.rig.rig import Rig, rig_from_json
from cairn_calib.solve.solve_plan import BROWN, FISHEYE, FOCAL_AND_CENTRE, CameraPlan, KnownNumbers, SolvePlan
from cairn_map.arrays import Floats
from cairn_map.errors import BadInputError

PLACE = tuple(POSE_UNITS)
NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
GRID = (32, 24)
"""Columns and rows of the pixels that a file's lens is held to."""


@dataclass(frozen=True, slots=True)
class _Wish:
    """One --prior or --hold; of a number without `path`, of a lens with it."""

    option: str
    camera: str
    source: str
    name: str = ""
    value: float = 0.0
    path: Path | None = None
    other: str | None = None
    """Name of the camera in the file; None: as here, or the only one."""
    sigma: float | None = None
    """Standard deviation of the number, or of the lens's pixels."""


@dataclass(frozen=True, slots=True)
class _FileLens:
    """Lens of a file, and the covariance of its intrinsics by name; None where it states none."""

    lens: Lens
    sigmas: tuple[tuple[str, ...], Floats] | None


def add_known_options(parser: argparse.ArgumentParser) -> None:
    """Add `--prior` and `--hold`."""
    parser.add_argument(
        "--prior",
        action="append",
        default=[],
        metavar="CAM=FILE[+-PX]",
        help="known before: a lens of rig.json or of a file that convert reads, or CAM.fx=VALUE+-SIGMA",
    )
    parser.add_argument(
        "--hold", action="append", default=[], metavar="CAM=FILE", help="exactly known, likewise; or CAM.fx=VALUE"
    )


def with_known(plan: SolvePlan, args: argparse.Namespace, sizes_px: Mapping[str, tuple[int, int]]) -> SolvePlan:
    """The plan with what `--prior` and `--hold` say about its cameras.

    Raises:
        BadInputError: an option is none, contradicts another, or its file is of another camera.
    """
    names = list(plan.cameras)
    wishes = [wish for text in args.prior for wish in _parse("--prior", text, names)]
    wishes += [wish for text in args.hold for wish in _parse("--hold", text, names)]
    cameras, known = dict(plan.cameras), []
    # Files first: a single number counts instead of the file's.
    for wish in sorted(wishes, key=lambda each: each.path is None):
        camera = cameras[wish.camera]
        if wish.path is not None:
            found = _file_lens(wish, sizes_px[wish.camera])
            cameras[wish.camera], prior = _with_lens(camera, wish, found)
            known += [prior] if prior is not None else []
            continue
        _refuse_number(wish, plan)
        known = [_without(each, wish.name) if each.camera == wish.camera else each for each in known]
        if wish.name not in PLACE:
            camera = replace(camera, known={**camera.known, wish.name: wish.value})
        if wish.option == "--hold":
            camera = replace(camera, held=(*camera.held, wish.name))
        elif wish.name in PLACE or camera.is_free(wish.name):
            sigma = wish.sigma or 0.0
            known.append(KnownNumbers.single(wish.camera, wish.source, wish.name, wish.value, sigma))
        else:
            raise BadInputError(
                "bad_arguments",
                f"{wish.option} {wish.source}: {wish.name} of {wish.camera} is held, so it has no prior",
            )
        cameras[wish.camera] = camera
    return replace(plan, cameras=cameras, known=tuple(each for each in known if each.names))


def _parse(option: str, text: str, names: Sequence[str]) -> list[_Wish]:
    key, equals, rest = text.partition("=")
    camera, _, name = key.rpartition(".")
    if equals and camera in names and name in (*FOCAL_AND_CENTRE, *BROWN, *PLACE):
        number = re.fullmatch(rf"({NUMBER})(?:\+-({NUMBER}))?", rest)
        if number is None or (number[2] is None) != (option == "--hold") or not float(number[2] or 1) > 0:
            wanted = f"{key}=VALUE" if option == "--hold" else f"{key}=VALUE+-SIGMA"
            raise BadInputError(
                "bad_arguments", f"{option} of a number is {wanted}, such as left.fx=1330+-5, got {text}"
            )
        sigma = None if number[2] is None else float(number[2])
        return [_Wish(option, camera, text, name=name, value=float(number[1]), sigma=sigma)]
    path, sigma = rest if key in names else text, None
    if found := re.fullmatch(rf"(.+)\+-({NUMBER})", path):
        path, sigma = found[1], float(found[2])
        if option == "--hold" or not sigma > 0:
            raise BadInputError("bad_arguments", f"+-PX is of --prior, in pixels above 0, got {option} {text}")
    path, _, other = path.partition("#")
    wish = _Wish(option, key, path, path=Path(path), other=other or None, sigma=sigma)
    if equals and key in names:
        return [wish]
    # Without a camera: all that the file has.
    if not Path(path).exists():
        raise BadInputError(
            "bad_arguments",
            f"{option} is CAM=FILE or CAM.NAME=VALUE with CAM one of {', '.join(names)} and NAME a number of its lens "
            f"or {', '.join(PLACE)}, or a file, got {text}",
        )
    shared = [name for name in names if name in _read(Path(path))]
    if not shared:
        raise BadInputError("unknown_camera", f"{path} has none of {', '.join(names)}: say {option} CAM={path}#NAME")
    return [replace(wish, camera=name) for name in shared]


def _read(path: Path) -> dict[str, _FileLens]:
    """The lenses of a file, by name."""
    text = read_text(path)
    if format_of_text(path, text) != RIG:
        return {each.name: _FileLens(each.camera, None) for each in read_cameras(path, text).cameras}
    rig = rig_from_json(text.encode())
    return {
        name: _FileLens(each.camera, _stated(rig, name, each.camera))
        for name, each in rig.cameras.items()
        if isinstance(each.camera, Lens)
    }


def _stated(rig: Rig, camera: str, lens: Lens) -> tuple[tuple[str, ...], Floats] | None:
    known = rig.calibration.covariance if rig.calibration is not None else None
    if known is None:
        return None
    own = [(each.camera, each.name) for each in known.parameters]
    at = [n for n, (owner, name) in enumerate(own) if owner == camera and name in lens.intrinsic_names]
    return tuple(own[n][1] for n in at), known.matrix[np.ix_(at, at)]


def _file_lens(wish: _Wish, size_px: tuple[int, int]) -> _FileLens:
    lenses = _read(Path(wish.source))
    found = lenses.get(wish.other or wish.camera)
    if found is None and wish.other is None and len(lenses) == 1:
        (found,) = lenses.values()
    if found is None:
        raise BadInputError(
            "unknown_camera",
            f"{wish.source} has no camera {wish.other or wish.camera}, but {', '.join(lenses)}: say {wish.option} "
            f"{wish.camera}={wish.source}#NAME",
        )
    if (found.lens.width, found.lens.height) != size_px:
        raise BadInputError(
            "bad_arguments",
            f"{wish.option} {wish.camera}: the lens of {wish.source} is of {found.lens.width} x {found.lens.height} "
            f"pixels, the images are of {size_px[0]} x {size_px[1]}",
        )
    return found


def _with_lens(camera: CameraPlan, wish: _Wish, found: _FileLens) -> tuple[CameraPlan, KnownNumbers | None]:
    """The camera with a file's lens, and the prior if it is one."""
    lens, names = found.lens, found.lens.intrinsic_names
    model = "kb4" if isinstance(lens, FisheyeCamera) else "pinhole"
    if camera.model == "kb4" != model:
        raise BadInputError("bad_arguments", f"--fisheye {wish.camera}: the lens of {wish.source} is none")
    values = dict(zip(names, lens.intrinsics.tolist(), strict=True))
    free = camera.free
    if free is None and any(values.get(each) for each in ("k4", "k5", "k6")):
        free = FISHEYE if model == "kb4" else BROWN
    camera = replace(camera, model=model, known=values, free=free)
    if wish.option == "--hold":
        return replace(camera, held=names), None
    if wish.sigma is not None:
        free_names = tuple(name for name in names if camera.is_free(name))
        return camera, _by_pixels(lens, wish, free_names, values, wish.sigma)
    if found.sigmas is None:
        raise BadInputError(
            "no_covariance",
            f"{wish.source} does not say how certain its lens is: say how far off its pixels may be, such as --prior "
            f"{wish.camera}={wish.source}+-0.5, or --hold it",
        )
    # What a covariance does not list counts as certain.
    listed, matrix = found.sigmas
    camera = replace(camera, held=tuple(name for name in names if name not in listed))
    at = [n for n, name in enumerate(listed) if camera.is_free(name)]
    if not at:
        return camera, None
    kept = tuple(listed[n] for n in at)
    numbers = np.array([values[name] for name in kept])
    return camera, KnownNumbers(wish.camera, wish.source, kept, numbers, matrix[np.ix_(at, at)])


def _by_pixels(
    lens: Lens, wish: _Wish, names: tuple[str, ...], values: Mapping[str, float], sigma_px: float
) -> KnownNumbers:
    """A lens whose pixels are off by a standard deviation, one axis, root mean square over the image."""
    rays = lens.unproject(image_grid(lens.width, lens.height, *GRID))
    columns = [lens.intrinsic_names.index(name) for name in names]
    J = lens.projection(rays[np.isfinite(rays).all(axis=1)]).by_intrinsics[..., columns].reshape(-1, len(names))
    # trace(J C J^T) / rows = sigma^2 for C = sigma^2 rows / K (J^T J)^-1; scaled, for units differ by a million.
    scale = np.linalg.norm(J, axis=0)
    inverse = np.linalg.inv((J / scale).T @ (J / scale)) / scale[:, None] / scale
    covariance = sigma_px**2 * len(J) / len(names) * inverse
    return KnownNumbers(wish.camera, wish.source, names, np.array([values[name] for name in names]), covariance)


def _refuse_number(wish: _Wish, plan: SolvePlan) -> None:
    camera = plan.cameras[wish.camera]
    if wish.name in PLACE:
        if wish.option == "--hold" or wish.camera == plan.gauge:
            raise BadInputError(
                "bad_arguments",
                f"{wish.option} {wish.source}: a place takes a --prior, of another camera than {plan.gauge}, whose "
                "frame is the rig's",
            )
    elif wish.name not in (*FOCAL_AND_CENTRE, *(FISHEYE if camera.model == "kb4" else BROWN)):
        raise BadInputError("bad_arguments", f"{wish.option} {wish.source}: {wish.camera} has no {wish.name}")


def _without(known: KnownNumbers, name: str) -> KnownNumbers:
    at = [n for n, each in enumerate(known.names) if each != name]
    names = tuple(known.names[n] for n in at)
    return replace(known, names=names, values=known.values[at], covariance=known.covariance[np.ix_(at, at)])
