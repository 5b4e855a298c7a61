"""README and the pages of docs/: their commands are accepted as written, their programs use the public door alone."""

import argparse
import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.fixtures.pages import PAGES, commands_of, programs_of

import cairn
from cairn_client.main import main

PAGES_WITH_COMMANDS = {
    "README.md",
    "administrator.md",
    "calibration-engineer.md",
    "calibration-tour.md",
    "live-robots.md",
    "operator.md",
    "paper-experiment.md",
    "robot-developer.md",
    "scale.md",
    "python-api.md",
    "simulated_robot.py",
}


class AcceptedError(Exception):
    """Raised where a command has understood its arguments and would begin to work."""


def test_pages_with_commands_are_found() -> None:
    assert {page.name for page in PAGES if list(commands_of(page))} == PAGES_WITH_COMMANDS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_is_accepted_as_it_is_written(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parse = argparse.ArgumentParser.parse_args

    def parse_alone(parser: argparse.ArgumentParser, *given: Any) -> None:
        parse(parser, *given)
        raise AcceptedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_alone)
    for arguments in commands_of(page):
        with pytest.raises(AcceptedError):
            main(arguments)


@pytest.mark.parametrize("page", [page for page in PAGES if page.suffix == ".md"], ids=lambda page: page.name)
def test_programs_of_a_page_import_only_names_of_the_public_door(page: Path) -> None:
    for program in programs_of(page):
        for node in ast.walk(ast.parse(program)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("cairn"):
                assert node.module == "cairn", f"{page.name}: from {node.module} import ..."
                assert {alias.name for alias in node.names} <= set(cairn.__all__)


@pytest.mark.processes
def test_the_robot_of_the_readme_passes_a_type_checker(tmp_path: Path) -> None:
    root = Path(__file__).parents[1]
    example = next(program for program in programs_of(root / "README.md") if "with Robot(" in program)
    (tmp_path / "robot.py").write_text(example)
    # With the cache of `make lint`: else all packages and NumPy are checked again for one page.
    options = ["--config-file", str(root / "pyproject.toml")]
    command = [sys.executable, "-m", "mypy", *options, str(tmp_path / "robot.py")]
    checked = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False)
    assert checked.returncode == 0, checked.stdout + checked.stderr
