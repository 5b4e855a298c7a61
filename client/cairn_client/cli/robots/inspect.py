"""`cairn robot inspect`: contents of a recording; for a bag of ROS also a proposal of the topics to map."""

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cairn_client.cli.arguments import Subparsers, say, shown_bytes
from cairn_client.cli.source_arguments import add_source_arguments, asked_source
from cairn_client.sync.responses import one_line
from cairn_fusion.recording.view_agreement import pose_doubt
from cairn_fusion.recording.way_doubts import way_doubts
from cairn_map.errors import USAGE, BadInputError, ConflictError
from cairn_map.progress import counting

if TYPE_CHECKING:
    from cairn_client.live.live_source import LiveSource
    from cairn_fusion.ros.bag_index import TopicIndex
    from cairn_fusion.ros.bag_recording import Survey

TEXT = """Say what a recording holds, how its poses were read, and which way is up in it, with the options of replay:

    $ cairn robot inspect clouds/ --poses poses.txt --poses-of rig

For a bag (FILE.bag, FILE.mcap, FILE.db3, a folder of rosbag2) without --topics, list its topics, and propose the YAML
file that says which of them are depth, colour, thermal images and poses. It needs no ROS.

    $ cairn robot inspect lab.bag --output lab.yaml
    $ cairn robot replay lab.bag --topics lab.yaml --map URL --voxel 0.04

A live robot is listened to for some seconds through its Foxglove bridge (or zenoh://HOST:PORT, or ros2:), and the same
file proposed for `live`:

    $ cairn robot inspect ws://robot:8765 --output live.yaml
    $ cairn robot live ws://robot:8765 --topics live.yaml --map URL --voxel 0.04

Facts that a bag does not hold stand at the head of the file as `DECIDE`; `replay` without --topics works where there is
nothing to decide."""


def _inspect(args: argparse.Namespace) -> int:
    from cairn_fusion.importers import SourceLayout, detect_layout

    if isinstance(args.bag, str):
        from cairn_client.live.live_doors import open_door

        _check_output(args)
        try:
            source = open_door(args.bag, ca_file=args.ca)
        except BadInputError as exc:
            sys.stderr.write(f"cairn robot inspect: {one_line(exc.message)} [{exc.kind}]\n")
            return USAGE
        return _show_survey(args, _listen(source, args.seconds))
    is_bag = args.depth is None and detect_layout(args.bag) is SourceLayout.BAG
    if not is_bag or args.topics is not None:
        _show_source(args)
        return 0
    _check_output(args)
    from cairn_fusion.ros.bag_recording import survey

    with counting(args.bag.name, "messages") as on_message:
        found = survey(args.bag, on_message=on_message)
    return _show_survey(args, found)


def _listen(source: "LiveSource", seconds: float) -> "Survey":
    """Survey of a live robot."""
    from cairn_client.live.live_opening import survey_live

    try:
        with counting(source.url, "messages") as on_message:
            return survey_live(source, seconds=seconds, on_message=on_message)
    finally:
        source.close()


def _check_output(args: argparse.Namespace) -> None:
    if args.output is not None and args.output.exists() and not args.force:
        raise ConflictError("file_exists", f"{args.output} exists; --force writes over it")


def _show_survey(args: argparse.Namespace, found: "Survey") -> int:
    """Write what a bag or a live robot holds, and the proposal."""
    if args.output is not None:
        args.output.write_text(found.proposal.text, encoding="utf-8")
    if args.json:
        say(json.dumps(_as_json(found)))
        return 0
    _show(found)
    if args.output is None:
        say()
        say(found.proposal.text.rstrip())
    else:
        say(f"{args.output} is written" + (": look for DECIDE in it" if found.proposal.questions else ""))
    for question in found.proposal.questions:
        sys.stderr.write(f"to decide: {question}\n")
    return 0


def _show_source(args: argparse.Namespace) -> None:
    """Write the contents of what replay would map."""
    from cairn_fusion.recording.upright import upright_of

    if args.output is not None:
        raise BadInputError("bad_option", "--output is about the topics of a bag")
    source = asked_source(args.bag, args)
    first, last = source.scan(0), source.scan(len(source) - 1)
    times = f", {last.time_s - first.time_s:.1f} s" if source.has_times else ""
    ranges_m = first.range_m[np.isfinite(first.range_m)]
    low_m, mid_m, high_m = np.quantile(ranges_m, (0.01, 0.5, 0.99)) if len(ranges_m) else (np.nan, np.nan, np.nan)
    upright = upright_of(source)
    up = "up: no floor was found" if upright is None else upright.text()
    if args.json:
        say(
            json.dumps(
                {
                    "path": str(args.bag),
                    "scans": len(source),
                    "times_s": [first.time_s, last.time_s] if source.has_times else None,
                    "cameras": {name: mounted.spectrum.value for name, mounted in source.rig.cameras.items()},
                    "poses": list(source.pose_notes),
                    "up": None if upright is None else upright.axis,
                }
            )
        )
        return
    say(f"{source.name}: {len(source)} scans{times}")
    for name, mounted in source.rig.cameras.items():
        say(f"  {name}: {mounted.spectrum.value}, {mounted.camera.width} x {mounted.camera.height} pixels")
    say(f"ranges of the first: {low_m:.2f} to {high_m:.2f} m, median {mid_m:.2f} m")
    for note in (*source.pose_notes, source.rounding.text(), pose_doubt(source), *way_doubts(source)):
        if note:
            say(note)
    say(up)


def _show(found: "Survey") -> None:
    topics = [topic for topic in found.index.topics.values() if len(topic)]
    count, size = sum(map(len, topics)), shown_bytes(sum(topic.size_bytes for topic in topics))
    times_s = [time_s for topic in topics for time_s in (topic.log_ns[0] / 1e9, topic.log_ns[-1] / 1e9)]
    start = datetime.fromtimestamp(min(times_s), UTC).strftime("%Y-%m-%d %H:%M:%S UTC") if times_s else "never"
    length_s = max(times_s) - min(times_s) if times_s else 0.0
    say(f"{found.path.name}: {count} messages in {len(topics)} topics, {size}, {length_s:.1f} s from {start}")
    width = max((len(name) for name in found.index.topics), default=5)
    say(f"{'topic':<{width}}  {'type':<29} {'count':>7} {'rate':>9} {'size':>9}  encoding, frame")
    for name, topic in found.index.topics.items():
        shape = f"{topic.image_size[0]} x {topic.image_size[1]}" if topic.image_size else ""
        wire = "" if topic.topic.wire else "not coded as ROS does"
        more = ", ".join(word for word in (topic.encoding, shape, topic.frame, wire) if word)
        rate, size = f"{topic.rate_hz:.1f} Hz", shown_bytes(topic.size_bytes)
        say(f"{name:<{width}}  {topic.topic.type:<29} {len(topic):>7} {rate:>9} {size:>9}  {more}")
    if found.index.tree.edges:
        moving = {child for child, edge in found.index.tree.edges.items() if not edge.is_fixed}
        say("frames (~> moves, -> does not):")
        for leaf in sorted(_leaves(found)):
            say(f"  {_way(found, leaf, moving)}")


def _leaves(found: "Survey") -> set[str]:
    tree = found.index.tree
    return tree.edges.keys() - {edge.parent for edge in tree.edges.values()}


def _way(found: "Survey", leaf: str, moving: set[str]) -> str:
    """A leaf of the tree and those it hangs on, root first."""
    *way, root = found.index.tree.way_up(leaf)
    return root + "".join(f" {'~>' if child in moving else '->'} {child}" for child in reversed(way))


def _as_json(found: "Survey") -> dict[str, object]:
    edges = found.index.tree.edges
    return {
        "path": str(found.path),
        "topics": [_topic_json(topic) for topic in found.index.topics.values()],
        "frames": [
            {"frame": child, "parent": edge.parent, "moves": not edge.is_fixed} for child, edge in sorted(edges.items())
        ],
        "proposal": found.proposal.text,
        "questions": list(found.proposal.questions),
    }


def _topic_json(topic: "TopicIndex") -> dict[str, object]:
    times_s = topic.times()
    return {
        "name": topic.topic.name,
        "type": topic.topic.type,
        "wire": topic.topic.wire,
        "count": len(topic),
        "rate_hz": topic.rate_hz,
        "size_bytes": topic.size_bytes,
        "encoding": topic.encoding or None,
        "image_size": topic.image_size,
        "frame": topic.frame or None,
        "times_s": [float(times_s.min()), float(times_s.max())] if len(times_s) else None,
    }


def add_parser(commands: Subparsers) -> None:
    """Add the subcommand."""
    inspect = commands.add_parser(
        "inspect",
        help="say what a recording holds; of a bag of ROS, propose the topics to map",
        description=TEXT,
    )
    inspect.add_argument(
        "bag",
        type=_recording,
        metavar="RECORDING",
        help="anything that replay takes, or ws://HOST:PORT, zenoh://HOST:PORT or ros2: of a live robot",
    )
    inspect.add_argument("--ca", type=Path, metavar="FILE", help="issuer of the certificate of wss:// (this machine's)")
    inspect.add_argument(
        "--seconds", type=float, default=5.0, metavar="S", help="time for which a live robot is listened to (5)"
    )
    inspect.add_argument("-o", "--output", type=Path, metavar="YAML", help="write the proposed file there")
    inspect.add_argument("--force", action="store_true", help="write over a file that exists")
    inspect.add_argument("--json", action="store_true", help="print JSON")
    add_source_arguments(inspect)
    inspect.set_defaults(run=_inspect)


def _recording(text: str) -> Path | str:
    """A path, or the URL of a live robot as it stands."""
    return text if "://" in text or text.startswith("ros2:") else Path(text)
