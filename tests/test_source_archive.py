"""The source archive carries the built page: whoever installs from it needs neither Node nor npm's packages."""

import os
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
STATIC = "server/cairn_server/static"
pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(
        not (ROOT / STATIC / "index.html").exists(),
        reason="the console is not built: `make console` where npm's packages can be had",
    ),
]
WITHOUT_NODE = {
    **{"PATH": "/nowhere", "HOME": "/nowhere", "NODE_OPTIONS": "--no-such-option"},
    **{"npm_config_registry": "http://127.0.0.1:9/"},
}
"""Who still starts Node or asks npm's registry fails."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is in the archive, unpacked."""
    folder = tmp_path_factory.mktemp("archive")
    _hatchling(ROOT, "build", "--target", "sdist", "--directory", str(folder))
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as found:
        found.extractall(folder, filter="data")
    (unpacked,) = (path for path in folder.iterdir() if path.is_dir())
    return unpacked


def test_the_archive_has_the_page_that_was_built_here(sources: Path) -> None:
    names = sorted(path.relative_to(ROOT / STATIC) for path in (ROOT / STATIC).rglob("*") if path.is_file())
    assert Path("index.html") in names
    assert {name: (sources / STATIC / name).read_bytes() for name in names} == {
        name: (ROOT / STATIC / name).read_bytes() for name in names
    }
    assert not list(sources.rglob("node_modules"))


def test_a_wheel_of_it_has_the_page_without_node(sources: Path, tmp_path: Path) -> None:
    _hatchling(sources, "build", "--target", "wheel", "--directory", str(tmp_path), **WITHOUT_NODE)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as found:
        assert found.read("cairn_server/static/index.html") == (ROOT / STATIC / "index.html").read_bytes()


@pytest.fixture
def without_page(sources: Path) -> Iterator[Path]:
    """The archive's sources as a fresh checkout has them: the page is not built."""
    (sources / STATIC).rename(sources / "gone")
    yield sources
    (sources / "gone").rename(sources / STATIC)


def test_an_editable_install_builds_no_page(without_page: Path) -> None:
    hook = (
        "import sys; sys.path.insert(0, 'server/console'); import hatch_build; "
        "hatch_build.ConsoleHook('.', {}, None, None, '', 'wheel').initialize('editable', {})"
    )
    _python(without_page, "-c", hook, **WITHOUT_NODE)
    assert not (without_page / STATIC).exists()


def test_a_checkout_installs_without_npm_and_its_page_says_how_to_get_it(without_page: Path, tmp_path: Path) -> None:
    _hatchling(without_page, "build", "--target", "wheel", "--directory", str(tmp_path), **WITHOUT_NODE)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as found:
        found.extractall(tmp_path / "installed")
    page = "from cairn_server.http.routes.console import ConsoleFiles; print(ConsoleFiles().page.plain.decode())"
    said = _python(tmp_path, "-c", page, PYTHONPATH=str(tmp_path / "installed"))
    assert "installed without this page" in said and "make console" in said


def test_no_archive_is_made_without_the_page(without_page: Path, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="the console was not built"):
        _hatchling(without_page, "build", "--target", "sdist", "--directory", str(tmp_path), **WITHOUT_NODE)


def _hatchling(folder: Path, *arguments: str, **env: str) -> None:
    _python(folder, "-m", "hatchling", *arguments, **env)


def _python(folder: Path, *arguments: str, **env: str) -> str:
    command = [sys.executable, *arguments]
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, **env}, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
