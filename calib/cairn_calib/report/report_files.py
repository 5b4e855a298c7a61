"""Files of a report: the page for people, and the same numbers as JSON next to it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.report.report_images import ReportImage
from cairn_calib.report.solve_json import examination_json
from cairn_calib.report.solve_report import report_page
from cairn_map.errors import BadInputError


def refuse_overwriting(report: Path | None, rig: Path) -> None:
    """Check that a report's JSON does not replace the rig that it reports on.

    Raises:
        BadInputError: both have the same path.
    """
    if report is not None and report.with_suffix(".json").resolve() == rig.resolve():
        raise BadInputError(
            "bad_arguments",
            f"the report's numbers go to {report.with_suffix('.json')}, which is {rig}: name the report otherwise",
        )


def write_report(path: Path, seen: Examination, images: Mapping[str, Sequence[ReportImage]]) -> str:
    """Write the report as HTML, and next to it as JSON; returns a line about both.

    Raises:
        BadInputError: a file cannot be written.
    """
    write_file(path, report_page(seen, images).encode())
    write_file(path.with_suffix(".json"), examination_json(seen))
    count = f"{len(seen.warnings)} warning{'s' * (len(seen.warnings) != 1)}"
    return f"{path}: {count}; the same as {path.stem}.json\n"


def write_file(path: Path, data: bytes) -> None:
    """Write a file.

    Raises:
        BadInputError: it cannot be written.
    """
    try:
        path.write_bytes(data)
    except OSError as exc:
        raise BadInputError("cannot_write", f"cannot write {path}: {exc.strerror}") from exc
