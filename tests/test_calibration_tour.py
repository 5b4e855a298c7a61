"""docs/calibration-tour.md: its sentences are those of the code, and what it shows is what the commands print."""

import ast
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
from tests.fixtures.pages import DOCS, PROGRAM, ROOT, commands_of, programs_of
from tests.fixtures.sources import docstrings, tree_of

from cairn_client.main import main

PAGE = DOCS / "calibration-tour.md"
SECTION = "## What to do if"
CALIB = ROOT / "calib" / "cairn_calib"
REFUSING = (
    *sorted((CALIB / "diagnosis").glob("*.py")),
    *sorted((CALIB / "solve").glob("*.py")),
    *(CALIB / "cli" / name for name in ("solve.py", "solve_options.py", "known_lenses.py")),
    CALIB / "board" / "frame_pairing.py",
)
"""Modules whose refusals `cairn calib solve` prints."""
OF_OPTIONS = {"bad_arguments", "unknown_camera"}
"""Kinds of refusals that quote an option and its right form: the page explains the kinds."""
UNPRINTED = {
    "\0 has too few frames for two halves": "cross_validate takes it for no comparison",
    "one camera of a rig measures ranges, got \0": "add_ranges reads the images of one camera",
    "a camera has two images of one frame": "read_board_views refuses it first, with both names",
    "views of unknown cameras: \0": "read_board_views names cameras by their folders",
}
"""Refusals that only a program can meet, with the reason."""
CONSTANT_MIN = 15
"""Characters of a sentence without its gaps, at the least: fewer would match anything."""
NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")


def template(node: ast.expr) -> str | None:
    """The text of a string, NUL for each value in it; None for another expression."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "\0" for part in node.values)
    return None


def sentences() -> list[str]:
    """Sentences of the page's section: what is in backticks on the first line of each entry."""
    section = PAGE.read_text(encoding="utf-8").partition(f"\n{SECTION}\n")[2]
    return [text for head in re.findall(r"^- (`.*)$", section, re.MULTILINE) for text in re.findall("`([^`]+)`", head)]


def is_of(sentence: str, message: str) -> bool:
    """True if the parts of a sentence between its gaps (...) occur in a message, in order."""
    parts = [re.escape(part.strip()) for part in sentence.split("...") if part.strip()]
    return re.search(".*?".join(parts), message, re.DOTALL) is not None


def calls(tree: ast.AST, name: str) -> Iterator[ast.Call]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name:
            yield node


def warnings_made() -> Iterator[str]:
    """Texts of all warnings about a solution."""
    for path in sorted(CALIB.rglob("*.py")):
        for function in ast.walk(tree_of(path)):
            if not isinstance(function, ast.FunctionDef):
                continue
            for call in calls(function, "SolveWarning"):
                text = call.args[5]
                given = [text]
                if isinstance(text, ast.Name):
                    given = [
                        node.value
                        for node in ast.walk(function)
                        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == text.id
                    ]
                found = [template(each) for each in given]
                assert found and None not in found, f"{path.name}:{call.lineno}: a warning whose text is not found"
                yield from filter(None, found)


def refusals_made() -> Iterator[str]:
    """Texts of the refusals of `cairn calib solve` that are about images, not about how it was called."""
    for path in REFUSING:
        for call in calls(tree_of(path), "BadInputError"):
            kind, text = call.args[0], template(call.args[1])
            if isinstance(kind, ast.Constant) and kind.value in OF_OPTIONS:
                continue
            if text is None:
                # A decisive warning is a refusal, too; `warnings_made` has it.
                assert ast.unparse(call.args[1]) == "str(wrong[0])", f"{path.name}:{call.lineno}"
            elif text not in UNPRINTED:
                yield text


def test_every_sentence_of_the_page_is_one_that_the_code_prints() -> None:
    messages = set()
    for path in sorted(CALIB.rglob("*.py")):
        tree = tree_of(path)
        inside = {part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
        skipped = {*docstrings(tree), *inside}
        nodes = [node for node in ast.walk(tree) if isinstance(node, ast.expr) and node not in skipped]
        messages |= {text for text in map(template, nodes) if text is not None}
    found = sentences()
    assert [each for each in found if not any(is_of(each, message) for message in messages)] == []
    assert [each for each in found if len(each.replace("...", "")) < CONSTANT_MIN] == []
    assert len(set(found)) == len(found), "an entry stands twice"


def test_every_warning_about_a_solution_has_an_entry() -> None:
    found, made = sentences(), set(warnings_made())
    assert [each for each in sorted(made) if not any(is_of(sentence, each) for sentence in found)] == []
    assert len(made) > 30


def test_every_refusal_of_a_solve_has_an_entry() -> None:
    found, made = sentences(), set(refusals_made())
    assert [each for each in sorted(made) if not any(is_of(sentence, each) for sentence in found)] == []
    assert len(made) > 15


@pytest.mark.processes
@pytest.mark.recording
@pytest.mark.skipif("CAIRN_TEST_DATA" not in os.environ, reason="CAIRN_TEST_DATA names no folder of recordings")
def test_commands_and_program_print_what_the_page_shows(tmp_path: Path) -> None:
    shutil.copytree(Path(os.environ["CAIRN_TEST_DATA"]) / "opencv_stereo_chess", tmp_path / "images")
    commands, (program,) = list(commands_of(PAGE)), programs_of(PAGE)
    with chdir(tmp_path):
        printed = [_run(arguments) for arguments in commands]
        with redirect_stdout(StringIO()) as out:
            exec(compile(program, str(PAGE), "exec"), {})
    shown = shown_on_the_page()
    assert len(shown) == len(commands) + 1 and all(shown), "a command or program whose output is not shown"
    for output, lines in zip([*printed, out.getvalue()], shown, strict=True):
        there = [line.strip() for line in output.splitlines()]
        for line in lines:
            alike = [numbers_of(each) for each in there if shape_of(each) == shape_of(line)]
            assert any(numbers_of(line) == pytest.approx(each, rel=0.05, abs=0.003) for each in alike), line + output


def _run(arguments: list[str]) -> str:
    """Output of a command, both streams in one."""
    words = [name for word in arguments for name in (sorted(map(str, Path().glob(word))) or [word])]
    with redirect_stdout(StringIO()) as out, redirect_stderr(out):
        code = main(words)
    assert code == 0, out.getvalue()
    return out.getvalue()


def shown_on_the_page() -> list[list[str]]:
    """Lines under each command of cairn, then under the program, as the page shows them; `...` stands for more."""
    text = PAGE.read_text(encoding="utf-8").partition(f"\n{SECTION}\n")[0]
    shown: list[list[str]] = []
    for line in text.splitlines():
        if line.startswith(("    $ cairn ", "```python")):
            shown.append([])
        elif line.startswith("    ") and shown and not in_program(text, line) and line.strip() != "...":
            shown[-1].append(line.strip())
    return shown


def in_program(text: str, line: str) -> bool:
    """True for a line of the page's program."""
    return any(line in program.splitlines() for program in PROGRAM.findall(text))


def shape_of(line: str) -> str:
    """A line without its numbers, and without the digest, which changes with a rig's time of making."""
    return NUMBER.sub("#", re.sub(r"digest \S+:", "digest:", line))


def numbers_of(line: str) -> list[float]:
    return [float(each) for each in NUMBER.findall(re.sub(r"digest \S+:", "", line))]
