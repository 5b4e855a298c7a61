"""The images of a calibration for its report: small, with the corners that were found, or why there are none.

`cairn calib corners` draws every image next to its document; here they are made small enough for one page.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from cairn_calib.board.corner_file import CornerFile, read_corner_file
from cairn_calib.board.corner_pictures import thumbnail
from cairn_calib.diagnosis.view_statistics import ViewResiduals

IMAGES_MAX = 60
"""Images of one camera at most: a page of some megabytes."""


@dataclass(frozen=True, slots=True)
class ReportImage:
    """One image of a camera."""

    document: CornerFile
    picture: bytes | None
    """JPEG; None where there is no picture next to the document."""
    source: Path | None = None
    """The picture's file."""


def report_images(folders: Mapping[str, Path]) -> dict[str, list[ReportImage]]:
    """The images in folders of corner documents, by camera; the first sixty of each."""
    return {
        camera: [
            ReportImage(read_corner_file(path), thumbnail(path.with_suffix(".png")), path.with_suffix(".png"))
            for path in sorted(folder.glob("*.json"))[:IMAGES_MAX]
        ]
        for camera, folder in folders.items()
    }


def image_figures(
    images: Mapping[str, Sequence[ReportImage]], residuals: Sequence[ViewResiduals]
) -> list[tuple[str, list[dict[str, str]]]]:
    """Figures of all images that have a picture, by camera: `svg`, the image's `name` and a `caption`."""
    used = {(each.camera, each.image): each for each in residuals}
    return [
        (camera, [_figure(each, used.get((camera, each.document.image))) for each in drawn])
        for camera, own in images.items()
        if (drawn := [each for each in own if each.picture is not None])
    ]


def _figure(image: ReportImage, used: ViewResiduals | None) -> dict[str, str]:
    document = image.document
    if not document.corners:
        last = document.attempts[-1] if document.attempts else None
        caption = f"no board ({last.stage}: {last.reason})" if last else "no board"
    elif used is None:
        caption = f"{len(document.corners)} corners, not used"
    else:
        out = f", {used.outliers} left out" if used.outliers else ""
        caption = f"{len(document.corners)} corners{out}, rms {used.rms_px:.2f} px"
    return {"svg": _overlay(image), "name": document.image, "caption": caption}


def _overlay(image: ReportImage) -> str:
    """The picture with its corners over it, as SVG: fine lines stay fine where it is printed."""
    document = image.document
    width, height = document.width or 1, document.height or 1  # only of images without a picture are there none
    line = width / 200
    data = base64.b64encode(image.picture or b"").decode()
    parts = [
        f'<svg viewBox="-0.5 -0.5 {width} {height}" role="img" aria-label="{escape(document.image)}">'
        f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="data:image/jpeg;base64,{data}"/>'
    ]
    if document.corners:
        places = sorted((each.row, each.column, *each.pixel) for each in document.corners)
        path = " ".join(f"{x:.1f},{y:.1f}" for _, _, x, y in places)
        x, y = places[0][2:]
        parts.append(
            f'<polyline points="{path}" fill="none" stroke="#ff5a1f" stroke-width="{line:.2f}"/>'
            f'<rect x="{x - 4 * line:.1f}" y="{y - 4 * line:.1f}" width="{8 * line:.1f}" height="{8 * line:.1f}" '
            f'fill="none" stroke="#19c37d" stroke-width="{1.5 * line:.2f}"/>'
        )
    return "".join([*parts, "</svg>"])
