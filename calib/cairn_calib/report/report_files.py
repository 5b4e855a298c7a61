"""Files of a report: the page for people, and the same numbers as JSON next to it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from cairn_calib.diagnosis.examination import Examination
from cairn_calib.diagnosis.verdict import Rank
from cairn_calib.report.report_images import ReportImage
from cairn_calib.report.solve_json import examination_json
from cairn_calib.report.solve_report import report_page
from cairn_map.errors import BadInputError


def refuse_overwriting(report: Path | None, rig: Path) -> None:
    """Check that a report does not replace the rig that it reports on.

    Raises:
        BadInputError: both have the same path.
    """
    if report is not None and report.resolve() == rig.resolve():
        raise BadInputError("bad_arguments", f"the report would replace {rig}: name it otherwise, such as report.html")


def write_report(path: Path, seen: Examination, images: Mapping[str, Sequence[ReportImage]], *, rig_path: Path) -> str:
    """Write the report as HTML, and next to it as JSON; returns a line about both.

    The JSON has the report's name, or, where the rig has that, with `-report`.

    Raises:
        BadInputError: a file cannot be written.
    """
    numbers = path.with_suffix(".json")
    if numbers.resolve() == rig_path.resolve():
        numbers = numbers.with_stem(f"{numbers.stem}-report")
    write_file(path, report_page(seen, images).encode())
    write_file(numbers, examination_json(seen))
    notes = sum(each.rank is Rank.NOTE for each in seen.warnings)
    counts = [(len(seen.warnings) - notes, "warning"), (notes, "note")]
    told = " and ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts)
    return f"{path}: {told}; the same as {numbers.name}\n"


def write_file(path: Path, data: bytes) -> None:
    """Write a file.

    Raises:
        BadInputError: it cannot be written.
    """
    try:
        path.write_bytes(data)
    except OSError as exc:
        raise BadInputError("cannot_write", f"cannot write {path}: {exc.strerror}") from exc
