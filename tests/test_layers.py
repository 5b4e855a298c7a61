"""The house rules of DESIGN.md section 2 and STYLE.md, held by reading the sources, not by running them.

map <- calib <- fusion <- client <- sim
map <- server                              client and server never import each other
"""

import ast
import re
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

FOLDERS = {
    "cairn_map": "fusion",
    "cairn_calib": "calib",
    "cairn_fusion": "fusion",
    "cairn_client": "client",
    "cairn_sim": "client",
    "cairn_server": "server",
}

MAY_IMPORT = {
    "cairn_map/*": set(),
    "cairn_calib/*": {"cairn_map.errors"},
    "cairn_fusion/*": {"cairn_map", "cairn_calib"},
    "cairn_client/*": {"cairn_fusion", "cairn_map", "cairn_calib"},
    "cairn_sim/*": {"cairn_client", "cairn_fusion", "cairn_map", "cairn_calib"},
    "cairn_server/*": {"cairn_map"},
}

MAY_NAME = {
    "cv2": [
        "cairn_calib/circle_grid.py",
        "cairn_calib/corner_detection.py",
        "cairn_calib/corner_pictures.py",
        "cairn_calib/disc_images.py",
        "cairn_calib/flir_file.py",
        "cairn_calib/saddle_points.py",
        "cairn_calib/still_frames.py",
        "cairn_calib/target_pictures.py",
        "cairn_fusion/across.py",
        "cairn_fusion/beyond_labels.py",
        "cairn_fusion/eye_depth.py",
        "cairn_fusion/images.py",
        "cairn_fusion/picture.py",
        "cairn_fusion/view/mjpeg.py",
        "cairn_fusion/view/painting.py",
        "cairn_fusion/view/temperature_scale.py",
        "cairn_sim/contact_sheet.py",
        "cairn_sim/fusion_truth.py",
        "cairn_sim/overlay_scores.py",
        "cairn_sim/render.py",
    ],
    "fastapi": [
        "cairn_server/*routes.py",
        "cairn_server/http_*.py",
        "cairn_server/problems.py",
        "cairn_server/serve_command.py",
    ],
    "starlette": [
        "cairn_server/*routes.py",
        "cairn_server/http_*.py",
        "cairn_server/problems.py",
        "cairn_server/serve_command.py",
    ],
    "uvicorn": ["cairn_server/serve_command.py", "cairn_server/http_*.py"],
    "httpx": ["cairn_client/api.py"],
    "apsw": [
        "cairn_server/sqlite_*.py",
        "cairn_client/sqlite_*.py",
        "cairn_client/replica_store.py",
        "cairn_fusion/bag_rosbags.py",
    ],
    "psycopg": [],
    "cryptography": ["cairn_map/signature.py"],
    "laspy": ["cairn_map/laz_file.py"],
    "lazrs": ["cairn_map/laz_file.py"],
    "small_gicp": ["cairn_client/alignment.py"],
    "mcap": ["cairn_fusion/bag_mcap.py"],
    "rosbags": ["cairn_fusion/bag_rosbags.py"],
    "lz4": ["cairn_fusion/bag_mcap.py", "cairn_fusion/bag_rosbags.py"],
    "ruamel": ["cairn_calib/yaml_text.py"],
    "numba": [
        "cairn_map/*_kernels.py",
        "cairn_map/compile_progress.py",
        "cairn_map/kernel_interrupts.py",
        "cairn_fusion/*_kernels.py",
        "cairn_sim/*_kernels.py",
    ],
}

EMPTY_NAMES = {"utils", "util", "helpers", "helper", "common", "manager", "base", "misc"}
LINES_MAX = 300
LONGER: dict[str, int] = {}
"""Modules that may be longer, and how long; never above 400."""
SHIPPED = ["*.md", "*.toml", "Makefile", ".dockerignore", ".ci/*", "docker/*"]
"""Besides the packages, tests and docs: files with text that a user gets to see."""
TEXT = {".py", ".md", ".toml", ".yaml", ".json", ""}


def modules() -> Iterator[tuple[str, Path]]:
    """All modules of the packages as `cairn_map/grid.py` and their files."""
    for package, folder in FOLDERS.items():
        for path in sorted((ROOT / folder / package).rglob("*.py")):
            yield path.relative_to(ROOT / folder).as_posix(), path


@cache
def imports(path: Path) -> set[str]:
    """Dotted names of the modules that a module imports from, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: import from the defining module by its full name"
            names.add(str(node.module))
    return names


def is_within(name: str, parents: set[str]) -> bool:
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


@cache
def texts() -> dict[str, str]:
    """Content of every text file that is shipped, by path."""
    folders = ["calib", "fusion", "client", "server", "tests", "docs"]
    found = {path for folder in folders for path in (ROOT / folder).rglob("*")}
    found |= {path for pattern in SHIPPED for path in ROOT.glob(pattern)}
    return {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(found)
        if path.suffix in TEXT and path.is_file() and "__pycache__" not in path.parts
    }


def test_packages_import_only_the_floors_below_them() -> None:
    wrong = []
    for module, path in modules():
        package = module.partition("/")[0]
        allowed = {package}.union(*(names for pattern, names in MAY_IMPORT.items() if fnmatch(module, pattern)))
        wrong += [
            f"{module}: {name}" for name in imports(path) if name.startswith("cairn_") and not is_within(name, allowed)
        ]
    assert wrong == []


def test_all_packages_of_the_wheel_are_looked_at() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert sorted(wheel) == sorted(f"{folder}/{package}" for package, folder in FOLDERS.items())


@pytest.mark.parametrize("library", sorted(MAY_NAME))
def test_heavy_libraries_are_named_in_few_files(library: str) -> None:
    users = {module for module, path in modules() if any(is_within(name, {library}) for name in imports(path))}
    assert {user for user in users if not any(fnmatch(user, pattern) for pattern in MAY_NAME[library])} == set()


def test_packages_begin_with_a_docstring_and_nothing_else() -> None:
    wrong = []
    for package, folder in FOLDERS.items():
        body = ast.parse((ROOT / folder / package / "__init__.py").read_text(encoding="utf-8"))
        if len(body.body) != 1 or not ast.get_docstring(body):
            wrong.append(package)
    assert wrong == []


def test_card_folders_are_no_packages() -> None:
    assert [folder for folder in FOLDERS.values() if (ROOT / folder / "__init__.py").exists()] == []


def test_modules_hold_one_noun() -> None:
    lines = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in modules()}
    assert {module: count for module, count in lines.items() if count > LONGER.get(module, LINES_MAX)} == {}
    assert {module: count for module, count in LONGER.items() if not LINES_MAX < lines.get(module, 0) <= 400} == {}


def test_modules_are_named_for_what_they_hold() -> None:
    parts = {module: set(re.split(r"[/_]", module.removesuffix(".py"))) for module, _ in modules()}
    assert {module: found for module, words in parts.items() if (found := words & EMPTY_NAMES)} == {}


def test_shipped_files_name_no_folder_of_somebodys_machine() -> None:
    machine_path = re.compile(r"(?<![\w.~])/(?:home|root|work|Users)/\w+")
    assert {path: found for path, text in texts().items() if (found := machine_path.findall(text))} == {}


def test_shipped_files_leave_nothing_to_do() -> None:
    left = re.compile(r"\b(?:T[O]DO|F[I]XME|X[X]X)\b")
    assert {path: found for path, text in texts().items() if (found := left.findall(text))} == {}


def test_every_entry_point_resolves() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    for group, points in groups.items():
        for name, value in points.items():
            found = EntryPoint(name, value, group).load()
            door = found.main if group in ("cairn.commands", "cairn.calib") else found
            assert callable(door), f"{group}: {name}"
