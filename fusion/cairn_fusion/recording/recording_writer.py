"""Writer of recordings; a half-written recording is never taken for a whole one.

    rig.json first  ->  images, then their list lines, scan by scan  ->  recording.json last, by rename

A folder with `rig.json` and no `recording.json` belongs to a writer that died; all files that its lists name exist.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np

from cairn_calib.rig.image_files import write_grey16
from cairn_calib.rig.rig import Rig
from cairn_fusion.recording.images import write_colour, write_labels
from cairn_fusion.recording.recording_format import (
    BODY_FILE,
    CHANNEL,
    HEADER_BYTES_MAX,
    HEADER_FILE,
    MEASUREMENTS_FILE,
    RIG_FILE,
    SCALARS_FILE,
    TRAJECTORY_FILE,
    RangeEncoding,
    RecordingHeader,
    ThermalEncoding,
    check_camera_name,
    encode_kelvin,
    encode_range,
)
from cairn_fusion.recording.scan import LabelNames, Scan, check_scan
from cairn_fusion.recording.trajectory import trajectory_line
from cairn_map.errors import BadInputError, ConflictError

RANGE_ENCODING = RangeEncoding()
THERMAL_ENCODING = ThermalEncoding()
LIST_COMMENTS: Mapping[str, str] = {
    TRAJECTORY_FILE: "# time tx ty tz qx qy qz qw (T_map_rig)\n",
    BODY_FILE: "# time tx ty tz qx qy qz qw (T_map_body)\n",
    MEASUREMENTS_FILE: "# first_time last_time\n",
    SCALARS_FILE: "# time channel value\n",
}


class RecordingWriter:
    """Writer of one recording, which is finished when the `with` block ends without an error.

    with RecordingWriter(folder, rig, name="lab-1") as recording:
        for scan in stop:
            recording.add(scan)
        recording.end_measurement()

    Args:
        path: a new or empty folder.
        rig: the cameras of all scans.
        name: of the recording; letters, digits, dot, dash, underscore.
        note: free text for people.
        range_encoding: units and convention of range images; a range that does not fit 16 bits is refused.
        thermal_encoding: the scale of all thermal images; a temperature that does not fit 16 bits is refused.

    Raises:
        ConflictError: the folder holds something already.
        BadInputError: a name that cannot be written, or a folder that cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        rig: Rig,
        *,
        name: str,
        note: str = "",
        range_encoding: RangeEncoding = RANGE_ENCODING,
        thermal_encoding: ThermalEncoding = THERMAL_ENCODING,
    ) -> None:
        self.folder = Path(path)
        self.rig = rig
        self._range_encoding = range_encoding
        self._thermal_encoding = thermal_encoding
        for camera in rig.cameras:
            check_camera_name(camera)
        try:
            self._header = RecordingHeader(name=name, note=note, range={})
        except ValueError as exc:
            raise BadInputError("bad_recording", f"not a recording's name and note: {name!r}") from exc
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if any(self.folder.iterdir()):
                raise ConflictError("recording_exists", f"{self.folder} must be empty to record into it")
            (self.folder / RIG_FILE).write_bytes(rig.to_json())
        except OSError as exc:
            raise BadInputError("bad_output", f"cannot record into {self.folder}: {exc.strerror}") from exc
        self._stack = ExitStack()
        self._lists: dict[str, TextIO] = {}
        self._label_table: dict[int, str | None] = {}
        self._recorded: dict[tuple[str, str], None] = {}
        """(list in the header, camera), in order of first use."""
        self._scan_count = 0
        self._first_s: float | None = None
        self._last_s = -np.inf
        self._grouped = False
        self._finished = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self._stack.close()

    def add(self, scan: Scan) -> None:
        """Write one scan's images and lines; scans come in order of time.

        Raises:
            BadInputError: the scan does not fit the rig, is not later than the one before, has a value that the
                encodings cannot hold, or a table of labels that the header cannot hold, or says where the body was
                when others did not, or the other way round. Nothing of it is in the lists then.
        """
        if self._finished:
            raise ConflictError("recording_exists", f"{self.folder} is finished; nothing can be added")
        check_scan(scan, self.rig)
        if scan.time_s <= self._last_s:
            raise BadInputError("bad_scan", f"scan times must increase, got {scan.time_s!r} after {self._last_s!r}")
        for channel, value in scan.scalars.items():
            if not CHANNEL.fullmatch(channel) or not np.isfinite(value):
                raise BadInputError(
                    "bad_scan", f"a channel's name and a finite number expected, got {channel!r} {value}"
                )
        if self._scan_count and (scan.T_map_body is not None) != (BODY_FILE in self._lists):
            raise BadInputError("bad_scan", "either every scan of a recording says where the body was, or none does")
        if scan.labels and self._label_table not in ({}, dict(scan.label_names)):
            raise BadInputError("bad_scan", "the label images of all scans of a recording share one table")
        recorded = self._recorded | dict.fromkeys(_images_of(scan))
        label_table = dict(scan.label_names) if scan.labels else self._label_table
        if (recorded, label_table) != (self._recorded, self._label_table):
            self._check_header(recorded, label_table)
        # Images first, then their lines: a list never names a file that is missing.
        time_s = float(scan.time_s)
        for list_name, relative in self._write_images(scan).items():
            self._list(list_name).write(f"{time_s!r} {relative}\n")
        self._recorded, self._label_table = recorded, label_table
        self._list(TRAJECTORY_FILE).write(trajectory_line(time_s, scan.T_map_rig))
        if scan.T_map_body is not None:
            self._list(BODY_FILE).write(trajectory_line(time_s, scan.T_map_body))
        for channel, value in scan.scalars.items():
            self._list(SCALARS_FILE).write(f"{time_s!r} {channel} {float(value)!r}\n")
        self._scan_count += 1
        self._last_s = time_s
        self._first_s = time_s if self._first_s is None else self._first_s

    def end_measurement(self) -> None:
        """Close the measurement of all scans since the last one; nothing when there are none.

        When it is never called, there is no `measurements.txt`, and every scan is a measurement of its own.
        """
        if self._first_s is not None:
            self._list(MEASUREMENTS_FILE).write(f"{self._first_s!r} {self._last_s!r}\n")
            self._first_s = None
            self._grouped = True

    def finish(self) -> None:
        """Close every list, bring it to the disk, and put `recording.json` in place, in one step; once.

        Images are left to the system's write-back: one that a power cut took is noticed when it is read.
        """
        if self._finished:
            return
        if self._grouped:
            self.end_measurement()
        self._list(TRAJECTORY_FILE)
        with self._stack:
            for file in self._lists.values():
                file.flush()
                os.fsync(file.fileno())
        # The header comes last, and in one step: it is what makes a folder a recording.
        header = self._header_of(self._recorded, self._label_table)
        partial = self.folder / f"{HEADER_FILE}.partial"
        with partial.open("wb") as head:
            head.write(header.to_json())
            head.flush()
            os.fsync(head.fileno())
        partial.replace(self.folder / HEADER_FILE)
        self._finished = True

    def _write_images(self, scan: Scan) -> dict[str, str]:
        """Every image of the scan, all encoded before one is written; each one's list, and its path in it."""
        name = f"{self._scan_count:06d}.png"
        camera = self.rig[scan.range_camera].camera
        # Encoding refuses values that do not fit, before any file is written.
        counts = {scan.range_camera: encode_range(scan.range_m, camera, self._range_encoding)}
        counts |= {thermal: encode_kelvin(kelvin, self._thermal_encoding) for thermal, kelvin in scan.thermal.items()}
        if scan.amplitude is not None:
            counts[f"{scan.range_camera}.amplitude"] = scan.amplitude
        for folder in [*counts, *scan.colour, *(f"{labelled}.labels" for labelled in scan.labels)]:
            (self.folder / "images" / folder).mkdir(parents=True, exist_ok=True)
        for folder, image in counts.items():
            write_grey16(self.folder / "images" / folder / name, image)
        for folder, colour in scan.colour.items():
            write_colour(self.folder / "images" / folder / name, colour)
        labels = {f"{camera_name}.labels": numbers for camera_name, numbers in scan.labels.items()}
        for folder, numbers in labels.items():
            write_labels(self.folder / "images" / folder / name, numbers)
        return {f"{folder}.txt": f"images/{folder}/{name}" for folder in [*counts, *scan.colour, *labels]}

    def _header_of(self, recorded: Iterable[tuple[str, str]], label_table: LabelNames) -> RecordingHeader:
        """Header of a recording of these images: (list in the header, camera)."""
        cameras: dict[str, list[str]] = {}
        for kind, camera in recorded:
            cameras.setdefault(kind, []).append(camera)
        names = {str(number): name for number, name in label_table.items()}
        return self._header.model_copy(
            update={
                "range": dict.fromkeys(cameras.get("range", ()), self._range_encoding),
                "amplitude": tuple(cameras.get("amplitude", ())),
                "colour": tuple(cameras.get("colour", ())),
                "thermal": dict.fromkeys(cameras.get("thermal", ()), self._thermal_encoding),
                "labels": dict.fromkeys(cameras.get("labels", ()), names),
            }
        )

    def _check_header(self, recorded: Iterable[tuple[str, str]], label_table: LabelNames) -> None:
        """Refuse images with which the recording's header would be larger than readers take.

        Raises:
            BadInputError: kind `bad_labels`: the table of labels, once for each camera, is too large.
        """
        size_bytes = len(self._header_of(recorded, label_table).to_json())
        if size_bytes > HEADER_BYTES_MAX:
            raise BadInputError(
                "bad_labels",
                f"with this table of {len(label_table)} labels for each camera {HEADER_FILE} has {size_bytes} bytes, "
                f"and may have {HEADER_BYTES_MAX}; leave out the numbers that no image holds",
            )

    def _list(self, name: str) -> TextIO:
        if name not in self._lists:
            file = self._stack.enter_context(
                (self.folder / name).open("w", encoding="utf-8", newline="\n", buffering=1)
            )
            file.write(LIST_COMMENTS.get(name, "# time path\n"))
            self._lists[name] = file
        return self._lists[name]


def _images_of(scan: Scan) -> Iterator[tuple[str, str]]:
    """(list in the header, camera) of each image of a scan."""
    yield "range", scan.range_camera
    if scan.amplitude is not None:
        yield "amplitude", scan.range_camera
    for kind, images in (("labels", scan.labels), ("colour", scan.colour), ("thermal", scan.thermal)):
        yield from ((kind, camera) for camera in images)
