"""The house rules of DESIGN.md section 2 and STYLE.md, held by reading the sources, not by running them.

map <- calib <- fusion <- client <- sim
map <- server                              client and server never import each other
map, calib, fusion, client <- cairn        the public door: names of theirs, and nothing of its own
"""

import ast
import re
import tomllib
from fnmatch import fnmatch
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from tests.fixtures.sources import FOLDERS, ROOT, imports, modules

MAY_IMPORT = {
    "cairn/*": {"cairn_client", "cairn_fusion", "cairn_map", "cairn_calib"},
    "cairn_map/*": set(),
    "cairn_calib/*": {"cairn_map.errors", "cairn_map.arrays", "cairn_map.progress"},
    "cairn_fusion/*": {"cairn_map", "cairn_calib"},
    "cairn_client/*": {"cairn_fusion", "cairn_map", "cairn_calib"},
    "cairn_sim/*": {"cairn_client", "cairn_fusion", "cairn_map", "cairn_calib"},
    "cairn_server/*": {"cairn_map"},
}

MAY_NAME = {
    "cv2": [
        "cairn_calib/board/corner_detection.py",
        "cairn_calib/board/corner_pictures.py",
        "cairn_calib/rig/image_files.py",
        "cairn_calib/verify/disc_images.py",
        "cairn_calib/thermal/flir_file.py",
        "cairn_calib/board/grid_fit.py",
        "cairn_calib/board/saddle_points.py",
        "cairn_calib/board/still_frames.py",
        "cairn_calib/exchange/opencv_corners.py",
        "cairn_calib/corner_search/coded_search.py",
        "cairn_calib/corner_search/tag_codes.py",
        "cairn_calib/corner_search/tag_detection.py",
        "cairn_calib/corner_search/image_search.py",
        "cairn_calib/corner_search/search_workers.py",
        "cairn_calib/board/discs/blobs.py",
        "cairn_calib/verify/target_pictures.py",
        "cairn_fusion/image_fusion/cross_view.py",
        "cairn_fusion/image_fusion/mirror_labels.py",
        "cairn_fusion/image_fusion/dense_depth.py",
        "cairn_fusion/recording/images.py",
        "cairn_fusion/view/picture.py",
        "cairn_fusion/view/mjpeg.py",
        "cairn_fusion/view/painting.py",
        "cairn_fusion/view/temperature_scale.py",
        "cairn_sim/robots/contact_sheet.py",
        "cairn_sim/evaluation/fusion_truth.py",
        "cairn_sim/evaluation/overlay_scores.py",
        "cairn_sim/render/render.py",
    ],
    "fastapi": [
        "cairn_server/http/*.py",
        "cairn_server/operations/serve.py",
    ],
    "starlette": [
        "cairn_server/http/*.py",
        "cairn_server/operations/serve.py",
        "cairn_fusion/view/mjpeg_server.py",
    ],
    "uvicorn": [
        "cairn_server/operations/serve.py",
        "cairn_server/http/middleware/deadlines.py",
        "cairn_server/http/middleware/head_checks.py",
        "cairn_fusion/view/mjpeg_server.py",
    ],
    "httpx": ["cairn_client/http/api.py"],
    "prometheus_client": ["cairn_server/metrics.py"],
    "apsw": [
        "cairn_server/store/sqlite/*.py",
        "cairn_client/folders/sqlite_glance.py",
        "cairn_client/replica/replica_schema.py",
        "cairn_client/replica/replica_store.py",
        "cairn_fusion/ros/db3_bag.py",
    ],
    "psycopg": ["cairn_server/store/postgres/*.py"],
    "obstore": ["cairn_server/store/objects/bucket.py"],
    "cryptography": ["cairn_map/commits/signature.py", "cairn_server/access/server_certificate.py"],
    "websockets": [
        "cairn_client/links/bridge_link.py",
        "cairn_client/live/foxglove_source.py",
        "cairn_client/publish/bridge_sink.py",
        "cairn_client/publish/foxglove_server.py",
    ],
    "zenoh": [
        "cairn_client/links/zenoh_link.py",
        "cairn_client/live/zenoh_source.py",
        "cairn_client/publish/zenoh_sink.py",
    ],
    "rclpy": [],
    "laspy": ["cairn_map/files/laz.py", "cairn_fusion/clouds/cloud_file.py"],
    "lazrs": ["cairn_map/files/laz.py"],
    "small_gicp": ["cairn_client/robot/alignment.py"],
    "mcap": ["cairn_fusion/ros/mcap_bag.py", "cairn_client/publish/mcap_file.py"],
    "rosbags": ["cairn_fusion/ros/ros1_bag.py", "cairn_fusion/ros/map_messages.py"],
    "matplotlib": ["cairn_calib/report/charts.py"],
    "jinja2": ["cairn_calib/report/page.py"],
    "lz4": ["cairn_fusion/ros/mcap_bag.py", "cairn_fusion/ros/ros1_bag.py"],
    "ruamel": ["cairn_calib/exchange/yaml_text.py"],
    "numba": [
        "cairn_map/*_kernels.py",
        "cairn_map/kernels/numba_runtime.py",
        "cairn_map/kernels/kernel_cache.py",
        "cairn_fusion/*_kernels.py",
        "cairn_sim/*_kernels.py",
    ],
}

ROOMS = {
    "cairn_map": """
        errors arrays progress machine_memory machine_clocks
        kernels evidence epochs codec.octree codec.entropy codec commits wire files queries.level queries queries.layers
        queries.native render warm_up
    """,
    "cairn_calib": "rig board board.discs exchange corner_search solve diagnosis report thermal verify cli",
    "cairn_fusion": "recording clouds ros transfer mapping.level mapping image_fusion view importers warm_up",
    "cairn_client": "replica sync http relay robot folders links publish live cli cli.doctor cli.maps cli.robots main",
    "cairn_sim": "scene render robots evaluation experiment study demo sim_command warm_up",
    "cairn_server": """
        memory_shares cell_room settings processes map_refusals
        store.attachments store store.objects store.sqlite store.sqlite.files store.postgres store.postgres.files
        store.settling
        metrics access live upkeep folding sync.checks sync views maps service
        http.middleware http.routes http operations
    """,
}
"""Rooms of each package and the modules at its root, from the ground up: each imports only what stands before it."""
DOOR = "cairn"
"""The public door: one `__init__.py` with code, which is all of it; no package of ours imports it."""
MODULES_MAX = 18
"""Modules in a room, its `__init__.py` not counted."""

EMPTY_NAMES = {"utils", "util", "helpers", "helper", "common", "manager", "base", "misc"}
LINES_MAX = 600
"""Lines of a module; above 400 it should be asked whether it holds two nouns."""
SHIPPED = ["*.md", "*.toml", "Makefile", ".dockerignore", ".ci/*", "docker/*"]
"""Besides the packages, tests and docs: files with text that a user gets to see."""
TEXT = {".py", ".md", ".toml", ".yaml", ".json", ""}


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


def place(package: str, module: str) -> tuple[int, str]:
    """Index and name of the room that holds a module (`replica.outbox`), or of the module itself at the root."""
    order = ROOMS[package].split()
    held = [room for room in order if is_within(module, {room})]
    assert held, f"{package}.{module} stands in no room of ROOMS"
    room = max(held, key=len)
    return order.index(room), room


def test_rooms_import_only_the_rooms_before_them() -> None:
    wrong = []
    for module, path in modules():
        package, _, inner = module.removesuffix(".py").replace("/", ".").partition(".")
        if inner.endswith("__init__"):
            continue
        index, room = place(package, inner)
        for name in imports(path):
            if name.startswith(f"{package}."):
                there, other = place(package, name.partition(".")[2])
                if there > index:
                    wrong.append(f"{room} -> {other}: {package}.{inner} imports {name}")
    assert sorted(wrong) == []


def test_modules_import_one_another_in_no_circle() -> None:
    found = {module.removesuffix(".py").replace("/", "."): imports(path) for module, path in modules()}
    left = {module: {name for name in names if name in found} for module, names in found.items()}
    while free := {module for module, names in left.items() if not names & left.keys()}:
        left = {module: names for module, names in left.items() if module not in free}
    assert sorted(left) == []


def test_rooms_are_few_and_of_a_size_to_look_over() -> None:
    held: dict[Path, int] = {}
    for _, path in modules():
        if path.name != "__init__.py":
            held[path.parent] = held.get(path.parent, 0) + 1
    folders = {package: ROOT / folder / package for package, folder in FOLDERS.items() if package != DOOR}
    assert {str(room): count for room, count in held.items() if count > MODULES_MAX} == {}
    rooms = {package: sum(room.parent == folder for room in held) for package, folder in folders.items()}
    assert {package: count for package, count in rooms.items() if not 5 <= count <= 10} == {}


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
        if package == DOOR:
            continue
        rooms = {path.parent for path in (ROOT / folder / package).rglob("*.py")}
        for room in sorted(rooms):
            body = ast.parse((room / "__init__.py").read_text(encoding="utf-8"))
            if len(body.body) != 1 or not ast.get_docstring(body):
                wrong.append(str(room))
    assert wrong == []


def test_the_public_door_is_one_file_that_no_package_imports() -> None:
    assert [module for module, _ in modules() if module.partition("/")[0] == DOOR] == [f"{DOOR}/__init__.py"]
    behind = [path for module, path in modules() if module.partition("/")[0] != DOOR]
    assert [str(path) for path in behind if any(is_within(name, {DOOR}) for name in imports(path))] == []


def test_card_folders_are_no_packages() -> None:
    assert [folder for folder in FOLDERS.values() if (ROOT / folder / "__init__.py").exists()] == []


def test_modules_hold_one_noun() -> None:
    lines = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in modules()}
    assert {module: count for module, count in lines.items() if count > LINES_MAX} == {}


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
