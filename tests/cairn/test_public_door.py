"""The public door `cairn`: every name is there, is listed, and costs nothing until it is used."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import pytest
from tests.fixtures.client.robot_program import scan_of
from tests.fixtures.client.robots import robot_in

import cairn

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "python-api.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| `(\w+)` \| (.+) \| (\d+\.\d+) \|$", re.MULTILINE)
"""A line of the page's table: name, meaning, version since which it is promised."""


def static_imports() -> dict[str, str]:
    """Module of each name that type checkers see."""
    tree = ast.parse(Path(cairn.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    froms = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in froms for alias in node.names}


def fresh(code: str) -> str:
    """Output of a program in an interpreter that has imported nothing of ours."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("name", cairn.__all__)
def test_a_name_is_what_its_defining_module_has(name: str) -> None:
    found = getattr(cairn, name)
    assert found is getattr(import_module(static_imports()[name]), name)
    assert found.__module__ == static_imports()[name]
    assert found.__doc__


def test_type_checkers_see_every_name_and_no_other() -> None:
    assert sorted(static_imports()) == sorted(cairn.__all__) == cairn.__all__


@pytest.mark.processes
@pytest.mark.processes
def test_a_star_import_brings_all_names() -> None:
    assert fresh("from cairn import *; print('Robot' in dir(), 'open_map' in dir())") == "True True"


@pytest.mark.processes
@pytest.mark.processes
def test_dir_lists_all_names_before_they_are_used() -> None:
    assert set(cairn.__all__) | {"__version__", "__all__", "__doc__"} <= set(dir(cairn))
    listed = fresh("import cairn; print(*(name for name in cairn.__all__ if name not in dir(cairn)))")
    assert listed == ""


def test_the_version_is_that_of_the_distribution() -> None:
    assert cairn.__version__ == version("cairn-robotics")


def test_another_name_is_refused_and_the_list_of_names_pointed_to() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Robots'; its names are in docs/python-api.md"):
        _ = cairn.Robots  # type: ignore[attr-defined]


@pytest.mark.processes
@pytest.mark.processes
def test_importing_the_door_imports_nothing_behind_it() -> None:
    heavy = "[m for m in sys.modules if m.partition('.')[0].startswith(('numpy', 'cairn_', 'numba', 'pydantic'))]"
    assert fresh(f"import sys, cairn; print({heavy})") == "[]"


def test_the_page_lists_exactly_the_names_of_the_door() -> None:
    rows = ROW.findall(PAGE)
    assert sorted(name for name, _, _ in rows) == cairn.__all__
    assert all(len(meaning) > 10 for _, meaning, _ in rows)


def test_things_say_what_they_are_in_one_line(tmp_path: Path) -> None:
    with robot_in(tmp_path) as robot:
        scan = scan_of(1)
        robot.observe(scan)
        commit = robot.commit()
        path = robot.snapshot().check_sphere([[0.5, 0.5, 0.5], [0.6, 0.5, 0.5]], radius_m=0.1)
        said = [repr(thing) for thing in (robot, scan, commit, robot.map, robot.snapshot(), path)]
    for text, begins in zip(
        said,
        ("Robot(mole on map lab", "Scan(1500000001", "Commit(mole.", "HistoryMap(", "MapSnapshot(", "PathStates(2"),
        strict=True,
    ):
        assert text.startswith(begins), text
        assert len(text) < 160, text
