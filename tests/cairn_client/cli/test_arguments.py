"""Parts that all commands share: lists of negative numbers, subcommands, exit codes in every help."""

import argparse

import pytest

from cairn_client.cli.arguments import Subparsers, parser, run_subcommand
from cairn_client.cli.robot_arguments import box, place


@pytest.mark.parametrize("text", ["-1,0.5,1", "1,-2,3", "-0.1,-0.2,-0.3"])
def test_a_place_may_begin_with_a_minus_as_argument_and_as_option(text: str) -> None:
    command = parser("cairn test", None)
    command.add_argument("there", type=place)
    command.add_argument("--near", type=place)
    args = command.parse_args([text, "--near", text])
    assert args.there == args.near == tuple(float(part) for part in text.split(","))


def test_a_box_and_a_single_number_may_begin_with_a_minus_and_options_stay_options() -> None:
    command = parser("cairn test", None)
    command.add_argument("--box", type=box)
    command.add_argument("--low", type=float)
    command.add_argument("-v", action="store_true")
    args = command.parse_args(["--box", "-1,-2,-3,0,0,0", "--low", "-5", "-v"])
    assert (args.box, args.low, args.v) == ((-1, -2, -3, 0, 0, 0), -5, True)


def test_a_subcommand_takes_lists_of_negative_numbers_too_and_its_exit_code_is_returned() -> None:
    seen: list[tuple[float, float, float]] = []

    def run(args: argparse.Namespace) -> int:
        seen.append(args.there)
        return 6

    def add_parser(commands: Subparsers) -> None:
        go = commands.add_parser("go")
        go.add_argument("there", type=place)
        go.set_defaults(run=run)

    assert run_subcommand("cairn test", None, [add_parser], ["go", "-1,0,0"]) == 6
    assert seen == [(-1, 0, 0)]


def test_an_unknown_subcommand_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run_subcommand("cairn test", None, [], ["go"])
    assert ended.value.code == 2
    assert "invalid choice" in capsys.readouterr().err
