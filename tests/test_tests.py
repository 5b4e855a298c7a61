"""House rules for the tests themselves, held by reading their sources.

What several tests share lies in `tests/fixtures/`, in `tests/naive` (slow twins) or in a plain module of their folder,
so that every test file can be run alone and moved without another. Tests that take long have a mark that says why
(pyproject.toml lists the marks): `make check` leaves those out, `make test` runs all.
"""

import ast
import tomllib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests"


TIERS = {"image", "browser", "processes", "fuzz", "slow"}
"""Marks of the tests that `make check` leaves out."""
STARTERS = {"subprocess", "multiprocessing", "get_context", "fork", "sync_playwright"}
"""Names without which no test starts a process or a browser of its own."""

Unit = tuple[str, str]
"""A function or class: its module and its name."""


@cache
def trees() -> dict[str, ast.Module]:
    """Modules under tests/ by their dotted names."""
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): ast.parse(path.read_text())
        for path in sorted(TESTS.rglob("*.py"))
    }


@cache
def imported(module: str) -> dict[str, str]:
    """Names that a module binds by `from ... import`, anywhere in it, and the dotted names behind them."""
    nodes = [node for node in ast.walk(trees()[module]) if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: f"{node.module}.{alias.name}" for node in nodes for alias in node.names}


@cache
def imports() -> dict[str, set[str]]:
    """For each module under tests/ the others of them that it imports."""
    found: dict[str, set[str]] = {}
    for module, tree in trees().items():
        names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
        names |= {part for name in imported(module).values() for part in (name, name.rpartition(".")[0])}
        found[module] = names & (trees().keys() - {module})
    return found


@cache
def units() -> dict[Unit, ast.stmt]:
    """All functions and classes at the top of modules under tests/."""
    return {
        (module, node.name): node
        for module, tree in trees().items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }


def meant(module: str, name: str) -> Unit | None:
    """The unit that a name stands for in a module: its own, an imported one, or a fixture of a conftest above."""
    head, _, attribute = name.partition(".")
    parts = module.split(".")
    above = [".".join([*parts[:n], "conftest"]) for n in range(len(parts) - 1, 0, -1)]
    for place in [module, *(conftest for conftest in above if conftest in trees())]:
        path = imported(place).get(head, f"{place}.{head}") + (f".{attribute}" if attribute else "")
        if (found := (path.rpartition(".")[0], path.rpartition(".")[2])) in units():
            return found
    return None


def names_in(node: ast.AST) -> set[str]:
    """Variables, arguments (fixtures are asked for by them), attributes and short texts of a definition."""
    names: set[str] = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            names.add(part.id)
        elif isinstance(part, ast.arg):
            names.add(part.arg)
        elif isinstance(part, ast.Attribute):
            names |= {part.attr} & STARTERS
            if isinstance(part.value, ast.Name):
                names.add(f"{part.value.id}.{part.attr}")
        elif isinstance(part, ast.Constant) and isinstance(part.value, str):
            names.add(part.value)  # usefixtures("name")
    return names


@cache
def starting() -> set[Unit]:
    """Units that start a process or a browser, themselves or through others that they name."""
    names = {unit: names_in(node) for unit, node in units().items()}
    found = {unit for unit, used in names.items() if used & STARTERS}
    uses = {unit: {other for name in used if (other := meant(unit[0], name))} for unit, used in names.items()}
    while more := {unit for unit, others in uses.items() if others & found} - found:
        found |= more
    return found


def marks(unit: Unit) -> set[str]:
    """Names of the marks of a test: its own and those of its module."""
    module = [
        node.value
        for node in trees()[unit[0]].body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark"
    ]
    own = getattr(units()[unit], "decorator_list", [])
    return {part.attr for node in [*module, *own] for part in ast.walk(node) if isinstance(part, ast.Attribute)}


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


def test_what_starts_a_process_or_a_browser_is_marked() -> None:
    tests = [unit for unit in starting() if is_collected(unit[0]) and unit[1].lower().startswith("test")]
    assert len(tests) > 100, "the search finds what it is for"
    assert sorted(".".join(unit) for unit in tests if not marks(unit) & TIERS) == []


def test_make_check_leaves_out_these_marks() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    listed = {line.partition(":")[0] for line in project["tool"]["pytest"]["ini_options"]["markers"]}
    assert listed >= TIERS
    assert f"-m 'not ({' or '.join(sorted(TIERS))})'" in (ROOT / "Makefile").read_text()
