"""Folder of corner documents and pictures, written one image at a time, whole or not at all.

    corners/left01.json     the document: what `cairn calib solve` reads; written last, it says that the image is done
    corners/left01.png      the picture, for people

A run that is cut leaves whole documents, each named by what its own image tells of the polarity; the end of a run
writes those again that all images together name otherwise.
"""

from pathlib import Path

from cairn_calib.corner_search.image_search import SearchedImage
from cairn_map.errors import BadInputError


def document_path(folder: Path, image: Path) -> Path:
    """Path of an image's document."""
    return folder / f"{image_name(image)}.json"


def picture_path(folder: Path, image: Path) -> Path:
    """Path of an image's picture."""
    return folder / f"{image_name(image)}.png"


def image_name(image: Path) -> str:
    """Name of an image without suffix, or of the folder of a still pose."""
    return image.resolve().name if image.is_dir() else image.stem


def write_outcome(folder: Path, image: Path, searched: SearchedImage) -> None:
    """Write an image's picture, then its document.

    Raises:
        BadInputError: a file cannot be written.
    """
    try:
        if searched.picture is not None:
            _write_whole(picture_path(folder, image), searched.picture)
        elif searched.counts_sha256 is None:
            picture_path(folder, image).unlink(missing_ok=True)  # of another image of this name
        text = searched.document.model_dump_json(indent=1) + "\n"
        _write_whole(document_path(folder, image), text.encode())
    except OSError as exc:
        raise BadInputError("cannot_write", f"cannot write {exc.filename or folder}: {exc.strerror}") from exc


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file under another name first, so that a reader or a run that is cut never sees half of it."""
    fresh = path.with_name(f"{path.name}.part")
    try:
        fresh.write_bytes(data)
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
