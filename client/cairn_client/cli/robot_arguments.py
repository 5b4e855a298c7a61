"""Arguments that the robot's commands share: map, part of it, limits, places, uncertainty of a pose."""

import argparse

import numpy as np

from cairn_client.cli.arguments import add_token
from cairn_client.replica.limits import KEEP_ACKED_S, Limits
from cairn_client.sync.link_profile import LINKS
from cairn_client.sync.scope import Scope
from cairn_fusion.mapping.scan_gate import GateBounds, ScanGate
from cairn_map.errors import BadInputError
from cairn_map.render.pose_spread import PoseSpread
from cairn_map.wire.messages import Mode


def add_map(command: argparse.ArgumentParser) -> None:
    """Add the map, the robot's name, and the options of `add_amount`."""
    command.add_argument("--map", required=True, metavar="URL", help="http://HOST:PORT/maps/NAME")
    command.add_argument("--name", help="the robot's name on the map")
    add_amount(command)


def add_amount(command: argparse.ArgumentParser) -> None:
    """Add options that bound the part of the map that is fetched, and the token."""
    command.add_argument("--box", type=box, metavar="X0,Y0,Z0,X1,Y1,Z1", help="fetch only cells in it, metres")
    command.add_argument(
        "--reply-bytes",
        type=int,
        metavar="BYTES",
        help="most bytes of cells in one reply; the rest comes in the next ones",
    )
    command.add_argument(
        "--link",
        choices=list(LINKS),
        default="good",
        help="small: some ten to some hundred kbit/s: commits in few bytes and parts, short replies (good)",
    )
    add_token(command)


def scope_of(args: argparse.Namespace, mode: Mode) -> Scope:
    """Part of the map to fetch, as the options say."""
    if args.reply_bytes is not None and mode == "low-end":
        raise BadInputError("bad_option", "--reply-bytes bounds the answers with differences; low-end fetches cells")
    return Scope(box_m=(args.box[:3], args.box[3:]) if args.box else None, reply_bytes_max=args.reply_bytes)


def add_limits(command: argparse.ArgumentParser) -> None:
    """Add options that bound what the robot keeps, in megabytes (10^6 bytes)."""
    quarter = "a quarter of the machine's, or of its container's; 0: no limit"
    for name, what, standard in (
        ("disk", "size of the robot's file, above which the server's farthest cells are dropped", "no limit"),
        ("memory", "size of the map in memory, above which the server's farthest cells are dropped", quarter),
        ("outbox", "size of commits that the server does not have for good, above which no more are made", "no limit"),
    ):
        command.add_argument(f"--{name}-max", type=float, metavar="MB", help=f"{what} ({standard})")
    command.add_argument(
        "--keep-acked",
        type=float,
        default=KEEP_ACKED_S,
        metavar="S",
        help="least seconds of running for which a commit's bytes stay after the server acknowledged it, whatever the "
        f"server says, while the limits leave room ({KEEP_ACKED_S:.0f})",
    )


def limits_of(args: argparse.Namespace) -> Limits:
    """The limits that the options give."""
    disk, memory, outbox = (
        None if megabytes is None else round(megabytes * 1e6)
        for megabytes in (args.disk_max, args.memory_max, args.outbox_max)
    )
    return Limits(disk_bytes_max=disk, memory_bytes_max=memory, outbox_bytes_max=outbox, keep_acked_s=args.keep_acked)


def add_kept_scans(command: argparse.ArgumentParser) -> None:
    """Add `--keep-scans`."""
    command.add_argument(
        "--keep-scans",
        type=float,
        default=0.0,
        metavar="MB",
        help="size of the newest scans kept in the robot's folder, so that their poses can be corrected by a program, "
        "and their rig by `cairn reprocess` (0)",
    )


def kept_scans_bytes(args: argparse.Namespace) -> int:
    """Bytes of scans to keep, as `--keep-scans` says."""
    megabytes: float = args.keep_scans
    if not 0 <= megabytes < float("inf"):
        raise BadInputError("bad_option", f"--keep-scans takes megabytes of 0 or more, got {megabytes:g}")
    return round(megabytes * 1e6)


def add_gate(command: argparse.ArgumentParser, *, standard: str) -> None:
    """Add the options that say which scans are taken; `standard` says what holds without them."""
    bounds = GateBounds()
    group = command.add_argument_group(
        "which scans are taken", f"A robot that stands still should not vote with every scan. {standard}"
    )
    for name, unit, value, text in (
        ("m", "METRES", bounds.step_m, "after this way"),
        ("deg", "DEGREES", bounds.turn_deg, "or this turn"),
        ("s", "SECONDS", bounds.pause_s, "or this time"),
    ):
        group.add_argument(
            f"--scan-every-{name}", type=float, metavar=unit, help=f"take a scan {text} since the last ({value:g})"
        )
    group.add_argument("--every-scan", action="store_true", help="take every scan")


def gate_of(args: argparse.Namespace, *, is_standard: bool) -> ScanGate:
    """The gate that the options describe; `is_standard`: there is one without options, too.

    Raises:
        BadInputError: a negative bound, or --every-scan with one.
    """
    given = {
        "step_m": args.scan_every_m,
        "turn_deg": args.scan_every_deg,
        "pause_s": args.scan_every_s,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if args.every_scan and given:
        raise BadInputError("bad_option", "--every-scan and --scan-every-m, -deg or -s exclude each other; give one")
    return ScanGate(GateBounds(**given) if given or (is_standard and not args.every_scan) else None)


def place(text: str) -> tuple[float, float, float]:
    """X,Y,Z in metres."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected X,Y,Z in metres, got {text!r}") from None
    return x, y, z


def box(text: str) -> tuple[float, ...]:
    """X0,Y0,Z0,X1,Y1,Z1 in metres."""
    parts = text.split(",")
    if len(parts) != 6:
        raise argparse.ArgumentTypeError(f"expected X0,Y0,Z0,X1,Y1,Z1 in metres, got {text!r}")
    return (*place(",".join(parts[:3])), *place(",".join(parts[3:])))


def add_spread_arguments(options: argparse.ArgumentParser) -> None:
    """Add `--sigma` and `--covariance`, of which one at most is given."""
    certain = options.add_mutually_exclusive_group()
    certain.add_argument(
        "--sigma", type=_sigma, default=(0.0, 0.0), metavar="M,DEG", help="standard deviations of the pose (0,0)"
    )
    certain.add_argument(
        "--covariance", type=_numbers, metavar="N,N,...", help="covariance of the pose, 21 numbers: see above"
    )


def spread_of(args: argparse.Namespace) -> PoseSpread:
    """Uncertainty of a pose, as `--covariance` or `--sigma` says.

    Raises:
        BadInputError: kind `bad_pose`: it is no covariance.
    """
    if args.covariance is not None:
        return PoseSpread.of_lower(args.covariance)
    return PoseSpread.of_sigmas(args.sigma[0], float(np.radians(args.sigma[1])))


def _sigma(text: str) -> tuple[float, float]:
    try:
        metres, degrees = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected METRES,DEGREES, such as 0.02,1; got {text!r}") from None
    return metres, degrees


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected numbers with commas between, got {text!r}") from None
