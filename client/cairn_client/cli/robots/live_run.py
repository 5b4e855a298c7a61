"""Run of `cairn robot live`: a live source opened, mapped by a robot until a signal comes, and its status written."""

import argparse
import sys
import time

from cairn_calib.rig.rig import Spectrum
from cairn_client.cli.arguments import say, shown_bytes
from cairn_client.cli.event_lines import Stopping, lines_on_stderr, until_signal
from cairn_client.cli.range_arguments import integrator_of, returns_line
from cairn_client.cli.robot_arguments import gate_of, kept_scans_bytes, limits_of, scope_of
from cairn_client.cli.robots.layer_option import bring_keys, choose_layer
from cairn_client.cli.robots.replay import default_name, ensure_map
from cairn_client.folders.state_folder import layer_of
from cairn_client.live.live_doors import open_door
from cairn_client.live.live_mapping import LiveMapping
from cairn_client.live.live_opening import OpenedLive, mapping_for, open_live
from cairn_client.live.live_source import LiveSource
from cairn_client.live.live_status import LiveStatus, StatusWatch
from cairn_client.live.path_corrections import PathCorrections
from cairn_client.live.scan_recorder import ScanRecorder
from cairn_client.robot.robot import Robot
from cairn_client.sync.responses import one_line
from cairn_fusion.mapping.class_votes import check_label_names
from cairn_fusion.ros.scan_decoder import ScanDecoder
from cairn_fusion.ros.topic_mapping import BagMapping
from cairn_map.codec.cell_code import Profile
from cairn_map.epochs.layer import MapLayer
from cairn_map.errors import USAGE, BadInputError, CairnError
from cairn_map.evidence.channels import COLOUR, INTENSITY, TEMPERATURE, Channel
from cairn_map.progress import StatusLine

TAKE_S = 0.1
"""Longest wait for messages."""
TERMINAL_EVERY_S, LOG_EVERY_S, JSON_EVERY_S = 0.5, 10.0, 1.0
"""Pauses between two status lines."""
FLUSH_S = 8.0
"""Longest push of waiting commits at the end: containers are killed ten seconds after they are asked to stop."""


def run_live(args: argparse.Namespace) -> int:
    """Open the source and map until a signal comes; the exit code."""
    with until_signal() as stopping:
        source = recorder = None
        try:
            # Everything that can be refused is, before anything is mapped.
            gate_of(args, is_standard=True)
            limits = limits_of(args)
            kept_bytes = kept_scans_bytes(args)
            if args.every <= 0:
                raise BadInputError("bad_option", f"--every takes seconds above 0, got {args.every:g}")
            mapping = mapping_for(args.source, args.topics, ca_file=args.ca)
            if mapping.corrections is not None and not kept_bytes:
                raise BadInputError(
                    "bad_option",
                    f"the topics file names corrections ({mapping.corrections.topic}), which move scans that are kept: "
                    "give --keep-scans 2000 (MB), or take corrections out of it",
                )
            source = open_door(args.source, ca_file=args.ca)
            opened = open_live(source, mapping)
            recorder = None if args.record is None else ScanRecorder(args.record, opened, mapping)
            name = args.name or default_name(mapping.name)
            choose_layer(args, name)
            layer = _layer_of(args, mapping)
            bring_keys(args.state, name, args.map)
            robot = Robot(
                opened.rig,
                args.map,
                directory=args.state,
                name=name,
                token=args.token.of(args.map),
                mode=args.mode,
                geometry=layer,
                integrator=integrator_of(args),
                scope=scope_of(args, args.mode),
                limits=limits,
                link=args.link,
                stay=args.stay,
                keep_scans_bytes=kept_bytes,
            )
        except CairnError as exc:
            if source is not None:
                source.close()
            if recorder is not None:
                recorder.close()
            sys.stderr.write(f"cairn robot live: {one_line(exc.message)} [{exc.kind}]\n")
            return USAGE
        return _map(args, source, mapping, opened, robot, recorder, stopping)


def _corrections(mapping: BagMapping, opened: OpenedLive, robot: Robot) -> PathCorrections | None:
    given, frame = mapping.corrections, mapping.frames.map
    if given is None:
        return None
    return PathCorrections(robot, topic=given.topic, frame=frame, T_path_rig=opened.T_path_rig)


def _layer_of(args: argparse.Namespace, mapping: BagMapping) -> MapLayer | None:
    """The map's layer, made if that is asked for; None without a link: the state folder may know it.

    Raises:
        BadInputError: kind `unknown_class`: the labels have names that the classes of the layer, or of the one that
            the folder knows, lack.
        ConflictError: another process has the folder open.
    """
    layer = ensure_map(args, lambda: _channels(mapping))
    # Before the robot is opened: closing it again would push what waits, and take it off the map.
    known = layer_of(args.state) or layer
    if known is not None:
        check_label_names(mapping.label_names, known.geometry)
    return layer


def _channels(mapping: BagMapping) -> tuple[Channel, ...]:
    """Channels that the cameras of a mapping can fill."""
    spectra = {camera.spectrum for camera in mapping.cameras.values() if camera.topic is not None}
    has_amplitude = any(camera.amplitude is not None for camera in mapping.cameras.values())
    has = (
        (COLOUR, Spectrum.COLOUR in spectra),
        (INTENSITY, has_amplitude),
        (TEMPERATURE, Spectrum.THERMAL in spectra),
    )
    return tuple(channel for channel, found in has if found)


def _map(
    args: argparse.Namespace,
    source: LiveSource,
    mapping: BagMapping,
    opened: OpenedLive,
    robot: Robot,
    recorder: ScanRecorder | None,
    stopping: Stopping,
) -> int:
    """Map until a signal comes."""
    decoder = ScanDecoder(args.source, mapping, opened.rig, opened.topics)
    live = LiveMapping(
        robot,
        opened.scans,
        decoder,
        gate_of(args, is_standard=True),
        profile=Profile(args.profile) if args.profile else None,
        corrections=_corrections(mapping, opened, robot),
        on_taken=(lambda ready: None) if recorder is None else recorder.add,
    )
    watch = StatusWatch(
        robot.name, source, opened.scans, live, opened.topics, time.monotonic(), opened.dropped, recorder
    )
    shown = _ShownStatus(watch, robot, as_json=args.json)
    try:
        with lines_on_stderr(robot.events()):
            robot.start_sync(every_s=args.every)
            live.step(opened.early)
            while not stopping.is_set():
                live.step(source.take(within_s=0.0 if live.is_behind else TAKE_S))
                watch.note_lead(time.time())
                shown.show_if_due()
            source.close()
            live.step(source.take(within_s=0.0))
            live.finish()
            last = shown.show_last()
            if recorder is not None:
                recorder.close()
            robot.close(flush_s=FLUSH_S)
    finally:
        source.close()
        # Its index first: the push may take all the time that a container has.
        if recorder is not None:
            recorder.close()
        robot.close(flush_s=FLUSH_S)
    if not args.json:
        causes = {"not moved": live.not_moved, "dropped": live.dropped, **last.left_out}
        left = "".join(f"; {count} {cause}" for cause, count in causes.items() if count)
        say(
            f"mapped {live.taken} scans of {last.arrived} as {live.commits} commits{left}; {robot.waiting} commits wait"
        )
        say(returns_line(robot.returns))
        if recorder is not None:
            size = shown_bytes(recorder.size_bytes)
            say(f"{args.record}: {recorder.scans} scans recorded, {size}; `cairn robot replay {args.record}` maps them")
    return 0


class _ShownStatus:
    """Status as it is written: JSON to standard output, or a line to standard error that a terminal replaces."""

    def __init__(self, watch: StatusWatch, robot: Robot, *, as_json: bool) -> None:
        self._watch = watch
        self._robot = robot
        self._as_json = as_json
        self._line = StatusLine()
        is_terminal = self._line.is_terminal
        self._every_s = JSON_EVERY_S if as_json else TERMINAL_EVERY_S if is_terminal else LOG_EVERY_S
        self._next_s = time.monotonic() + min(self._every_s, JSON_EVERY_S)

    def show_if_due(self) -> None:
        """Write the status, unless the last one is too recent."""
        if time.monotonic() >= self._next_s:
            self.show()

    def show_last(self) -> LiveStatus:
        """Write the status, and make room on a terminal for what follows."""
        status = self.show()
        if not self._as_json:
            self._line.clear()
        return status

    def show(self) -> LiveStatus:
        """Write the status."""
        now_s = time.monotonic()
        self._next_s = now_s + self._every_s
        status = self._watch.status(now_s, time.time(), commits_waiting=self._robot.waiting)
        if self._as_json:
            say(status.model_dump_json())
            sys.stdout.flush()
        else:
            self._line.show(one_line(self._watch.line(status)))
        return status
