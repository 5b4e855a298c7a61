"""Calibrate cameras and rigs, and exchange them with other programs.

    $ cairn calib check rig.json
    $ cairn calib convert rig.json camchain.yaml --format kalibr

`cairn calib COMMAND --help` for each. Frames, pixels and units: calib/CONVENTIONS.md.
"""

import argparse
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points

from cairn_calib.cli import check as check_command
from cairn_calib.cli import compare as compare_command
from cairn_calib.cli import convert as convert_command
from cairn_calib.cli import convert_corners as convert_corners_command
from cairn_calib.cli import corners as corners_command
from cairn_calib.cli import report as report_command
from cairn_calib.cli import solve as solve_command
from cairn_calib.cli import thermal as thermal_command

# A subcommand is a module with `add_parser(commands)`, which sets `run`, a function of the parsed arguments; or, where
# it needs recordings or the simulator, one with `main(argv)` behind an entry point of GROUP.
SUBCOMMANDS = (
    check_command,
    compare_command,
    convert_command,
    convert_corners_command,
    corners_command,
    solve_command,
    report_command,
    thermal_command,
)
GROUP = "cairn.calib"
ELSEWHERE = {
    "verify": "how well a rig carries circle targets between its cameras",
    "study": "which board images calibrate best, in the simulator",
}


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    for point in entry_points(group=GROUP):
        if argv and argv[0] == point.name:
            done: int = import_module(point.module).main(argv[1:])
            return done
    top = argparse.ArgumentParser(
        "cairn calib", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for module in SUBCOMMANDS:
        module.add_parser(commands)
    for name, what in ELSEWHERE.items():
        commands.add_parser(name, help=what)
    args = top.parse_args(argv)
    run: Callable[[argparse.Namespace], None] = args.run
    run(args)
    return 0
