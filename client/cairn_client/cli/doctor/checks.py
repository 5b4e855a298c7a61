"""Checks of `cairn doctor`, a function each: the installation, a state folder, and the way to a server.

Each check has a result, what was found, and the next step where one is needed.
"""

import json
import platform
import shutil
import statistics
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import find_spec
from pathlib import Path

from cairn_client.cli.arguments import shown_bytes
from cairn_client.cli.compile import GROUP as WARM_UPS
from cairn_client.folders.state_folder import is_copy, opened_replica
from cairn_client.http.api import PROTOCOL_VERSION, MapApi
from cairn_client.http.http_link import index_of
from cairn_map.errors import CairnError, ConflictError, DeniedError, NotFoundError, UnreachableError
from cairn_map.evidence.grid import Cell, Geometry
from cairn_map.kernels.numba_runtime import is_compiled, known_kernels

PINGS = 5
LATENCY_WARN_S = 1.0
DAY_S = 86_400.0
CERTIFICATE_WARN_S = 14 * DAY_S
"""Two weeks: Let's Encrypt's clients renew at a month."""
CLOCK_WARN_S, CLOCK_FAIL_S = 5.0, 3600.0
"""Seconds between the clocks. A robot's clock dates its scans; an hour off is another time zone, or no clock at all."""
DATE_ERROR_S = 1.0
SPEED_WARN_BYTES = 8_000
"""Bytes a second: 64 kbit/s."""
MEASURED_BYTES_MIN = 20_000
"""Least size of a cell for a measurement of speed: below, latency hides the time that the bytes take."""
WAITING_WARN = 1000

PACKAGE = "cairn-robotics"
PYTHON_MIN = (3, 11)
EXTRAS: Mapping[str, tuple[str, str]] = {
    "cv2": ("robot", "images of recordings cannot be read"),
    "rosbags": ("robot", "bags of ROS 1 cannot be read"),
    "mcap": ("robot", "MCAP files cannot be read"),
    "fastapi": ("server", "`cairn serve` does not start"),
    "uvicorn": ("server", "`cairn serve` does not start"),
}
"""Optional modules: the extra that brings each, and the functions that fail without it."""
DISK_WARN_BYTES, DISK_FAIL_BYTES = 2 << 30, 64 << 20


class CheckResult(StrEnum):
    """Result of a check."""

    OK = "ok"
    WARN = "warn"
    """Outcome of a check that passed in part: usable, with something to mend."""
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the doctor's report."""

    what: str
    verdict: CheckResult
    found: str
    advice: str = ""
    """The next step, where one is needed."""

    def as_json(self) -> dict[str, str]:
        """Its fields, for JSON."""
        return {"what": self.what, "verdict": self.verdict, "found": self.found, "advice": self.advice}


def installation_checks() -> Iterator[Check]:
    """Checks of Python, cairn, the libraries of optional commands, and kernels."""
    yield _python()
    yield _cairn()
    yield from _extras()
    yield _kernels()


def disk_check(folder: Path) -> Check:
    """Room where a folder is, or will be."""
    place = folder.absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    found = f"{shown_bytes(free)} free at {place}"
    if free < DISK_FAIL_BYTES:
        return Check("disk", CheckResult.FAIL, found, "make room: a robot that cannot write cannot keep its commits")
    if free < DISK_WARN_BYTES:
        return Check("disk", CheckResult.WARN, found, "make room soon; a day's commits may take gigabytes")
    return Check("disk", CheckResult.OK, found)


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.machine()}"
    if sys.version_info < PYTHON_MIN:
        return Check("python", CheckResult.FAIL, found, f"cairn needs Python {'.'.join(map(str, PYTHON_MIN))} or later")
    return Check("python", CheckResult.OK, found)


def grid_check(api: MapApi, map_name: str, own: Geometry) -> Check:
    """Check of a folder's grid against that of its map."""
    try:
        there = api.map_info(map_name).geometry
    except CairnError as exc:
        return Check("grid", CheckResult.WARN, f"not compared: {exc.message} [{exc.kind}]", "mend the link first")
    if there != own:
        return Check(
            "grid",
            CheckResult.FAIL,
            f"the folder has {own}, map {map_name} has {there}",
            "its waiting commits stay in it, and fit no other grid: keep the folder, and start with a new one",
        )
    return Check("grid", CheckResult.OK, f"{own}, here and there")


def _cairn() -> Check:
    try:
        return Check("cairn", CheckResult.OK, version(PACKAGE))
    except PackageNotFoundError:
        return Check(
            "cairn", CheckResult.WARN, "runs from its sources", f"pip install {PACKAGE}, to have `cairn` itself"
        )


def _extras() -> Iterator[Check]:
    for extra in sorted({extra for extra, _ in EXTRAS.values()}):
        missing = {name: what for name, (of, what) in EXTRAS.items() if of == extra and find_spec(name) is None}
        if not missing:
            yield Check(f"extra {extra}", CheckResult.OK, "all there")
            continue
        lacks = "; ".join(sorted(set(missing.values())))
        found = f"{', '.join(missing)} missing: {lacks}"
        yield Check(f"extra {extra}", CheckResult.WARN, found, f'pip install "{PACKAGE}[{extra}]" if you need it')


def _kernels() -> Check:
    """Count of a robot's kernels that are compiled and kept: those with an index file where Numba looks for one."""
    for point in entry_points(group=WARM_UPS):
        if not point.extras:
            point.load()
    kernels = [kernel for kernel in known_kernels() if not kernel.py_func.__name__.startswith("_")]
    ready = sum(is_compiled(kernel) for kernel in kernels)
    found = f"{ready} of {len(kernels)} compiled"
    if ready < len(kernels):
        advice = "`cairn compile` compiles them now, half a minute; else the first scans wait for it"
        return Check("kernels", CheckResult.WARN, found, advice)
    return Check("kernels", CheckResult.OK, found)


def folder_checks(folder: Path) -> Iterator[Check]:
    """Checks of a robot's folder or a copy: sound, its owner, and the commits that wait in it."""
    yield disk_check(folder)
    try:
        with opened_replica(folder) as replica:
            waiting = replica.push_set()
            size = shown_bytes(replica.store.data_bytes(waiting))
            whose = f"{replica.author.robot} on map {replica.store.get('map')}, {len(replica.cells)} cells, sound"
            yield Check("folder", CheckResult.OK, f"{'copy' if is_copy(replica) else 'robot'} {whose}")
    except ConflictError as exc:
        yield Check("folder", CheckResult.WARN, exc.message, "stop the robot to have its folder checked")
        return
    except CairnError as exc:
        yield Check(
            "folder", CheckResult.FAIL, f"{exc.message} [{exc.kind}]", "move the folder away, and clone or start again"
        )
        return
    if len(waiting) > WAITING_WARN:
        advice = "see whether the link works: `cairn doctor URL`"
        yield Check("queue", CheckResult.WARN, f"{len(waiting)} commits wait, {size}", advice)
    else:
        yield Check("queue", CheckResult.OK, f"{len(waiting)} commits wait, {size}")


def server_checks(server_url: str, map_name: str | None, *, token: str | None) -> Iterator[Check]:
    """Checks of a server: reachable, near, protocol, ready, clock, token, speed of the link."""
    with MapApi(server_url, token=token) as api:
        try:
            waits_s, offset_s = _pings(api)
        except UnreachableError as exc:
            is_there = exc.kind == "other_scheme"
            advice = "give that URL" if is_there else "start it, or look at the network between"
            yield Check("server", CheckResult.FAIL, exc.message, advice)
            return
        except CairnError as exc:
            advice = "update the older of the two" if exc.kind == "unknown_protocol" else "is this a cairn server?"
            yield Check("server", CheckResult.FAIL, f"{exc.message} [{exc.kind}]", advice)
            return
        yield _latency(waits_s)
        yield Check("protocol", CheckResult.OK, f"version {PROTOCOL_VERSION}, here and there")
        yield clock_check(offset_s, max(waits_s))
        if api.sockets.certificate_end_s is not None:
            yield certificate_check(api.sockets.certificate_end_s - time.time())
        yield _ready(api)
        allowed = _token(api, map_name)
        yield allowed
        if allowed.verdict is CheckResult.OK and map_name is not None:
            yield _speed(api, map_name)


def _pings(api: MapApi) -> tuple[list[float], float | None]:
    """Round trips in seconds without the first, which makes the connection; and the lead of the server's clock."""
    waits_s: list[float] = []
    offset_s: float | None = None
    for _ in range(PINGS + 1):
        start_s, sent_s = time.monotonic(), time.time()
        answer = api.probe("/healthz")
        waits_s.append(time.monotonic() - start_s)
        date = answer.headers.get("date")
        if date:
            # HTTP's time is cut to whole seconds, and made once a second: it is up to two seconds old.
            offset_s = parsedate_to_datetime(date).timestamp() + DATE_ERROR_S - (sent_s + waits_s[-1] / 2)
    return waits_s[1:], offset_s


def _latency(waits_s: list[float]) -> Check:
    median_s = statistics.median(waits_s)
    found = f"answers in {1e3 * median_s:.1f} ms (median of {len(waits_s)}; {1e3 * max(waits_s):.1f} ms at worst)"
    if median_s > LATENCY_WARN_S:
        return Check(
            "server", CheckResult.WARN, found, "a slow link: --reply-bytes keeps replies short, --box their reach"
        )
    return Check("server", CheckResult.OK, found)


def clock_check(offset_s: float | None, wait_s: float) -> Check:
    """Check of the lead of the server's clock, seconds, measured to within `DATE_ERROR_S` and half of `wait_s`."""
    if offset_s is None:
        return Check("clock", CheckResult.WARN, "the server does not state its time", "compare the clocks by hand")
    error_s = DATE_ERROR_S + wait_s / 2
    if abs(offset_s) <= error_s:
        return Check("clock", CheckResult.OK, f"the server's agrees with ours, to within {error_s:.1f} s")
    found = f"the server's is {offset_s:+.1f} s from ours, to within {error_s:.1f} s"
    advice = "set this machine's clock (NTP, chrony): commits state when their scans were taken"
    if abs(offset_s) > CLOCK_FAIL_S:
        return Check("clock", CheckResult.FAIL, found, advice)
    if abs(offset_s) > CLOCK_WARN_S + wait_s / 2:
        return Check("clock", CheckResult.WARN, found, advice)
    return Check("clock", CheckResult.OK, found)


def certificate_check(left_s: float) -> Check:
    """Check of the time for which the server's certificate is still valid."""
    ends = f"{datetime.fromtimestamp(time.time() + left_s, UTC):%Y-%m-%d %H:%M} UTC"
    found = f"valid for {left_s / DAY_S:.1f} days, until {ends}"
    if left_s < CERTIFICATE_WARN_S:
        advice = "renew it in time, and send the server SIGHUP (a proxy has its own way): no client takes an ended one"
        return Check("certificate", CheckResult.WARN, found, advice)
    return Check("certificate", CheckResult.OK, found)


def _ready(api: MapApi) -> Check:
    try:
        answer = api.probe("/readyz")
    except CairnError as exc:
        return Check(
            "ready", CheckResult.FAIL, f"{exc.message} [{exc.kind}]", "see the server's log; docs/administrator.md"
        )
    # A clock that is not trusted has a check of its own.
    ills = [ill for ill in _degraded(answer.body) if not ill.startswith("clock_")]
    if ills:
        return Check("ready", CheckResult.WARN, f"takes pushes; {'; '.join(ills)}", "see the server's log")
    return Check("ready", CheckResult.OK, "takes pushes and folds them")


def _degraded(body: bytes) -> list[str]:
    """Complaints of a server that is ready all the same, each as `code: what`."""
    try:
        return [str(ill) for ill in str(json.loads(body).get("degraded") or "").split("; ") if ill]
    except (ValueError, AttributeError):
        return []


def _token(api: MapApi, map_name: str | None) -> Check:
    shown = "a token" if api.token else "no token"
    try:
        if map_name is None:
            return Check("token", CheckResult.OK, f"{shown}: {len(api.maps())} maps may be seen")
        info = api.map_info(map_name)
    except DeniedError as exc:
        return Check(
            "token", CheckResult.FAIL, f"{shown}: {exc.message} [{exc.kind}]", "give a good one: --token, CAIRN_TOKEN"
        )
    except NotFoundError as exc:
        return Check(
            "map", CheckResult.FAIL, exc.message, "`cairn map ls SERVER` lists maps, `cairn map create` makes one"
        )
    except CairnError as exc:
        return Check("token", CheckResult.FAIL, f"{exc.message} [{exc.kind}]", "see the server's log")
    return Check(
        "token", CheckResult.OK, f"{shown}: map {map_name} may be read; {info.cells} cells, {info.commits} commits"
    )


def _speed(api: MapApi, map_name: str) -> Check:
    """Check of the speed at which the largest cell comes: some hundred kilobytes, so a lower bound on fast links."""
    try:
        cells = index_of(api, map_name).cells
        entry = cells[int(cells.table["size_bytes"].argmax())] if len(cells) else None
        if entry is None or entry.size_bytes < MEASURED_BYTES_MIN:
            return Check("speed", CheckResult.OK, "not measured: no cell of the map is large enough")
        start_s, before = time.monotonic(), api.traffic.down_bytes
        api.cell(map_name, Cell(*entry.cell))
        size, taken_s = api.traffic.down_bytes - before, time.monotonic() - start_s
    except CairnError as exc:
        return Check("speed", CheckResult.FAIL, f"{exc.message} [{exc.kind}]", "see the server's log")
    found = f"{shown_bytes(size / taken_s)}/s down: a cell of {shown_bytes(size)} in {1e3 * taken_s:.0f} ms"
    if size / taken_s < SPEED_WARN_BYTES:
        return Check("speed", CheckResult.WARN, found, "a slow link: commit with --profile small, fetch with --box")
    return Check("speed", CheckResult.OK, found)
