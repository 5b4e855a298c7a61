"""House rules for the tests themselves, held by reading their sources.

What several tests share lies in `tests/fixtures/`, in `tests/naive` (slow twins) or in a plain module of their folder,
so that every test file can be run alone and moved without another.
"""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests"


@cache
def imports() -> dict[str, set[str]]:
    """Modules under tests/ by their dotted names, and which others of them each imports, anywhere in it."""
    paths = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted(TESTS.rglob("*.py"))
    }
    return {name: imported(path) & (paths.keys() - {name}) for name, path in paths.items()}


def imported(path: Path) -> set[str]:
    """All dotted names that a module imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def is_collected(name: str) -> bool:
    """True for modules that only pytest loads: test files and conftest."""
    last = name.rpartition(".")[2]
    return last.startswith("test_") or last == "conftest"


def test_no_module_imports_a_test_file_or_a_conftest() -> None:
    wrong = [f"{name} imports {other}" for name, others in imports().items() for other in others if is_collected(other)]
    assert sorted(wrong) == []


def test_modules_of_tests_import_one_another_in_no_circle() -> None:
    left = imports()
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    assert sorted(left) == []


def test_tests_mirror_the_rooms() -> None:
    """A folder tests/<package>/<room> exists only for a room that exists."""
    rooms = {
        path.relative_to(folder).as_posix()
        for folder in (ROOT / name for name in ("calib", "fusion", "client", "server"))
        for package in folder.glob("cairn_*")
        for path in [package, *package.rglob("*/")]
    }
    folders = {path.relative_to(TESTS).as_posix() for package in TESTS.glob("cairn_*") for path in package.rglob("*/")}
    assert {folder for folder in folders if "__pycache__" not in folder} - rooms == set()
