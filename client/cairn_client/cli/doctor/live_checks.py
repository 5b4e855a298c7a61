"""Checks of a live robot, in the words of `cairn robot live`: its door, topics, poses and clock; nothing is mapped."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from cairn_client.cli.doctor.checks import Check, CheckResult
from cairn_client.live.live_doors import open_door
from cairn_client.live.live_opening import OpenedLive, mapping_for, open_live
from cairn_client.live.live_source import LiveSource
from cairn_client.live.source_watch import SourceWatch, TopicStatus
from cairn_fusion.ros.bag import BagMessage
from cairn_fusion.ros.live_scans import ReadyScan
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import BagMapping
from cairn_map.errors import CairnError
from cairn_map.machine_clocks import MACHINE_CLOCKS, MachineClocks

SURVEY_S, OPEN_S = 2.0, 5.0
"""Longest listening for a proposal, and longest wait for what the head is built from: a robot without it is known
within ten seconds."""
WATCH_S = 3.0
"""Time for which scans are counted."""
SILENT_S = 2.0
TAKE_S = 0.1
GUIDE = "docs/live-robots.md has what a robot needs, by sentence"


def live_checks(
    url: str, topics_file: Path | None, *, ca_file: Path | None = None, clocks: MachineClocks = MACHINE_CLOCKS
) -> Iterator[Check]:
    """Checks of a live source, each with its result.

    Args:
        url: of its door (`live_source`).
        topics_file: meaning of its topics; None: as proposed.
        ca_file: issuer of the certificate of wss://.
        clocks: of this machine.
    """
    source = None
    try:
        mapping = mapping_for(url, topics_file, ca_file=ca_file, within_s=SURVEY_S)
        source = open_door(url, ca_file=ca_file)
        opened = open_live(source, mapping, within_s=OPEN_S, steady_s=clocks.steady_s)
        yield Check("door", CheckResult.OK, f"{url} offers {len(source.topics)} topics")
        yield Check("head", CheckResult.OK, f"built from {', '.join(sorted(opened.rig.cameras))}")
        yield from _arrivals(url, source, mapping, opened, clocks)
    except CairnError as exc:
        yield Check("live", CheckResult.FAIL, f"{exc.message} [{exc.kind}]", GUIDE)
    finally:
        if source is not None:
            source.close()


def _arrivals(
    url: str, source: LiveSource, mapping: BagMapping, opened: OpenedLive, clocks: MachineClocks
) -> Iterator[Check]:
    """Checks of what comes within some seconds.

    Raises:
        CairnError: a frame that carries cameras moves, or an image cannot be read.
    """
    watch = SourceWatch(source, opened.scans, opened.topics, silent_s=SILENT_S)
    # Stage 1: what came while it was opened; rates are counted from here on.
    _scans_of(opened, opened.early, clocks.steady_s())
    arrived, left = opened.scans.arrived.total(), Counter(opened.scans.left_out)
    first, start_s = Counter(source.counts), clocks.steady_s()
    names = sorted(opened.topics)
    # Stage 2: scans as they would be mapped, of which the first is decoded.
    ready, decoder = 0, ScanDecoder(url, mapping, opened.rig, opened.topics)
    span_s, statuses = 0.0, list[TopicStatus]()
    while span_s < WATCH_S:
        for scan in _scans_of(opened, source.take(within_s=TAKE_S), clocks.steady_s()):
            if not ready:
                decoder.decode(scan.found, scan.messages.__getitem__, scan.pose_at)
            ready += 1
        watch.note_lead(clocks.wall_s())
        now_s, counts = clocks.steady_s(), source.counts
        span_s = max(now_s - start_s, TAKE_S)
        rates_hz = {name: (counts[name] - first[name]) / span_s for name in names}
        statuses = watch.topic_statuses(now_s, counts, rates_hz, dropped=source.dropped)
    # Stage 3: what is missing, in the words of the status line.
    silences = watch.silences(statuses)
    shown = ", ".join(f"{status.topic} {status.rate_hz:.1f}/s" for status in statuses if status.rate_hz)
    verdict = CheckResult.FAIL if silences else CheckResult.OK
    yield Check("topics", verdict, "; ".join(silences) or shown, GUIDE if silences else "")
    left = opened.scans.left_out - left
    causes = [f"{count / span_s:.1f}/s {cause.value}" for cause, count in left.most_common()]
    causes += [opened.scans.frame_error] if opened.scans.frame_error else []
    found = f"{ready / span_s:.1f} scans/s of {(opened.scans.arrived.total() - arrived) / span_s:.1f}"
    found += f"; {'; '.join(causes)}" if causes else ""
    verdict = CheckResult.FAIL if not ready else CheckResult.WARN if causes else CheckResult.OK
    yield Check("scans", verdict, found, "" if verdict is CheckResult.OK else GUIDE)
    fault = watch.clock_fault
    agrees = "the robot's agrees with this machine's" if watch.lead_s is not None else "unknown: no image came"
    verdict = CheckResult.FAIL if fault else CheckResult.OK
    yield Check("robot clock", verdict, fault or agrees, "set both by NTP or chrony" if fault else "")


def _scans_of(opened: OpenedLive, messages: list[BagMessage], now_s: float) -> list[ReadyScan]:
    """Scans that these messages complete, at a steady time."""
    for message in messages:
        opened.scans.add(message, now_s)
    return list(opened.scans.ready(now_s))
