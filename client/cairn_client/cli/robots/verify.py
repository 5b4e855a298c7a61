"""Verify a calibrated rig with circle targets: the error of points that are carried from one camera to another.

    $ cairn calib verify rig.json drive-1 --output verified
    camera            n  sigma_x sigma_y   sigma  95 % interval  bias x bias y    rms expected = calibr. centroid  range
    colour_left     112     1.08    0.91    1.00   0.85 to 1.14    0.11   0.13   1.00     1.03 =    0.25     1.00   0.03
    ...
    180 targets in 60 images; look at verified/verification.html

Heated discs of aluminium, 20 and 30 cm wide, with matt black paper in their middle (so that the time-of-flight camera
has a range) and red reflecting tape on their rim, are set up; the robot drives, and records. Each disc's centroid in
the amplitude image is carried into every other camera's image, by its range and Eq. 1 to 6 of Kocmanova et al., and
compared with the centroid there. The result is their Table 2, with the errors expected from each source: calibration
(rig.json's own covariance, which `cairn calib solve` writes), centroids, and range.

    rms above expected, sigma not       a bias: one camera has moved, or a range is off: see the figures by range
    rms and sigma above expected        the calibration promises too much, or targets were confused

`--method paper` takes centroids as the paper does; the default weighs pixels by their brightness. RECORDING is a folder
as for `cairn robot replay`; of its own rig.json only the images' sizes must be those of RIG.

DIR gets verification.html (table, Figs 9 to 16), verification.json (every difference), and targets-CAMERA.png to look
at.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cairn_calib.board.corner_pictures import Picture, write_picture
from cairn_calib.rig.rig import Rig, Spectrum, load_rig
from cairn_calib.verify.disc_images import Method
from cairn_calib.verify.target_pictures import TILES_MAX, target_tile, tile_sheet
from cairn_calib.verify.verification import CENTROID_SIGMA_PX, Sightings, add_sights, find_targets, range_camera_of
from cairn_calib.verify.verification_report import verification_json, verification_page
from cairn_calib.verify.verification_table import table_of, table_text
from cairn_client.cli.arguments import parser, say
from cairn_fusion.recording.recording import open_recording
from cairn_fusion.recording.scan import Scan
from cairn_map.errors import BadInputError, NotFoundError
from cairn_map.progress import with_progress

Image = npt.NDArray[np.generic]


def main(argv: list[str]) -> int:
    """Run the subcommand."""
    options = parser("cairn calib verify", __doc__)
    options.add_argument("rig", type=Path, metavar="RIG", help="rig.json to verify")
    options.add_argument("recording", type=Path, metavar="RECORDING", help="a recording with targets in view")
    options.add_argument(
        "--method", choices=("grey", "paper"), default="grey", help="method of finding centroids (grey)"
    )
    options.add_argument("--output", type=Path, default=Path("verified"), metavar="DIR", help="(verified)")
    options.add_argument(
        "--centroid-sigma",
        type=float,
        metavar="PX",
        help="standard deviation of the range camera's centroids, if you know it better",
    )
    args = options.parse_args(argv)
    rig, recording = load_rig(args.rig), open_recording(args.recording)
    method: Method = args.method
    sightings = Sightings(rig, range_camera_of(rig), method)
    tiles: dict[str, list[Picture]] = {name: [] for name in sightings.cameras}
    sigmas = _sigmas(method, args.centroid_sigma)
    for number, scan in enumerate(with_progress(recording, "images", total=len(recording))):
        images = images_of(scan, rig, sightings.source)
        found = find_targets(rig, images, scan.range_m, name=f"{number:06d}", method=method)
        before = len(sightings.sights)
        add_sights(sightings, found, centroid_sigma_px=sigmas)
        for sight in sightings.sights[before:]:
            if len(tiles[sight.camera]) < TILES_MAX:
                tiles[sight.camera].append(target_tile(images[sight.camera], sight))
    rows = table_of(sightings)
    if not rows:
        reasons = "; ".join(f"{count} {reason}" for reason, count in sightings.left_out.items())
        raise NotFoundError(
            "no_targets",
            f"no camera found two of {sightings.targets} targets in {sightings.images} images "
            f"({reasons or 'none seen'}); are the discs heated, and their rims of red reflecting tape?",
        )
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "verification.json").write_text(verification_json(sightings, rows), encoding="utf-8")
    (args.output / "verification.html").write_text(verification_page(sightings, rows), encoding="utf-8")
    for name, own in tiles.items():
        if own:
            write_picture(args.output / f"targets-{name}.png", tile_sheet(own))
    say(table_text(rows))
    say(f"{sightings.targets} targets in {sightings.images} images; look at {args.output / 'verification.html'}")
    return 0


def images_of(scan: Scan, rig: Rig, range_camera: str) -> Mapping[str, Image]:
    """The pictures of a scan in which targets are looked for, by camera.

    Raises:
        BadInputError: the range camera is another one, has no amplitude, or an image is not of the rig's size.
    """
    if scan.range_camera != range_camera or scan.amplitude is None:
        raise BadInputError(
            "no_amplitude", f"the recording must have range and amplitude of {range_camera}, the rig's range camera"
        )
    images: dict[str, Image] = {range_camera: scan.amplitude, **scan.colour, **scan.thermal}
    for name, image in images.items():
        rig[name].camera.check_image(image, name=f"image of {name}")
    return images


def _sigmas(method: Method, of_range_px: float | None) -> Mapping[Spectrum, float]:
    usual = CENTROID_SIGMA_PX[method]
    if of_range_px is None:
        return usual
    if not 0 <= of_range_px < 100:
        raise BadInputError("bad_arguments", f"--centroid-sigma is in pixels, 0 to 100, got {of_range_px:g}")
    return {**usual, Spectrum.RANGE: of_range_px}
