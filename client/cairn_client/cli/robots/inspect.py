"""`cairn robot inspect`: the topics of a bag of ROS, and a proposal of those to map."""

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cairn_client.cli.arguments import Subparsers, say, shown_bytes
from cairn_map.errors import ConflictError
from cairn_map.progress import counting

if TYPE_CHECKING:
    from cairn_fusion.ros.bag_index import TopicIndex
    from cairn_fusion.ros.bag_recording import Survey

TEXT = """List the topics of a bag (FILE.bag, FILE.mcap, FILE.db3, or a folder of rosbag2), and propose the YAML file
that says which of them are depth, colour, thermal images and poses. It needs no ROS.

    $ cairn robot inspect lab.bag --output lab.yaml
    $ cairn robot replay lab.bag --topics lab.yaml --map URL --voxel 0.04

Facts that a bag does not hold stand at the head of the file as `DECIDE`; `replay` without --topics works where there is
nothing to decide."""


def _inspect(args: argparse.Namespace) -> int:
    from cairn_fusion.ros.bag_recording import survey

    if args.output is not None and args.output.exists() and not args.force:
        raise ConflictError("file_exists", f"{args.output} exists; --force writes over it")
    with counting(args.bag.name, "messages") as on_message:
        found = survey(args.bag, on_message=on_message)
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
        help="list the topics of a bag of ROS, and propose those to map",
        description=TEXT,
    )
    inspect.add_argument("bag", type=Path, help="FILE.bag, FILE.mcap, FILE.db3, or a folder of rosbag2")
    inspect.add_argument("-o", "--output", type=Path, metavar="YAML", help="write the proposed file there")
    inspect.add_argument("--force", action="store_true", help="write over a file that exists")
    inspect.add_argument("--json", action="store_true", help="print JSON")
    inspect.set_defaults(run=_inspect)
