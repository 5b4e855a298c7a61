"""Calibrate cameras and rigs, and exchange them with other programs.

    $ cairn calib convert rig.json camchain.yaml --format kalibr

`cairn calib COMMAND --help` for each. Frames, pixels and units: calib/CONVENTIONS.md. A subcommand is a module with
`add_parser(commands)`, which sets `run`, a function of the parsed arguments.
"""

import argparse
from collections.abc import Callable

from cairn_calib import convert_command, corners_command, solve_command, thermal_command

SUBCOMMANDS = (convert_command, corners_command, solve_command, thermal_command)


def main(argv: list[str]) -> int:
    """Run one of the subcommands."""
    top = argparse.ArgumentParser(
        "cairn calib", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for module in SUBCOMMANDS:
        module.add_parser(commands)
    args = top.parse_args(argv)
    run: Callable[[argparse.Namespace], None] = args.run
    run(args)
    return 0
