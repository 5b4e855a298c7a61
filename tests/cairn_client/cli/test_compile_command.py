"""`cairn compile` runs every kernel; in a process of its own, since other tests call kernels too."""

import subprocess
import sys

import pytest

from cairn_client.cli.compile import main

LOOK_AT_KERNELS = """
import sys
from importlib import import_module
from pathlib import Path

from cairn_client.cli.compile import main
from cairn_map.kernels.numba_runtime import known_kernels
from cairn_map.warm_up import SERVER_KERNELS, SERVER_PARTS
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher
from numba.core.types import BaseNamedTuple

for part in SERVER_PARTS.values():
    part()
if (count := sum(bool(kernel.signatures) for kernel in known_kernels())) != SERVER_KERNELS:
    sys.exit(f"a server calls {count} kernels, not {SERVER_KERNELS} (SERVER_KERNELS)")
main([])
for package in ("cairn_map", "cairn_fusion", "cairn_sim"):
    folder = Path(import_module(package).__file__).parent
    for path in sorted(folder.rglob("*_kernels.py")):
        module = import_module(".".join(path.relative_to(folder.parent).with_suffix("").parts))
        for name, value in vars(module).items():
            if not isinstance(value, Dispatcher):
                continue
            # Kernels without a cache of their own are called by others alone, and are kept within those.
            if isinstance(value._cache, NullCache):
                continue
            if any(isinstance(kernel.signature.return_type, BaseNamedTuple) for kernel in value.overloads.values()):
                sys.exit(f"{module.__name__}.{name} makes a named tuple: ^C crashes it (numba_runtime.py)")
            if not value.signatures and not name.startswith("_"):
                sys.exit(f"{module.__name__}.{name} is not called by {package}.warm_up")
"""


@pytest.mark.processes
def test_every_kernel_is_compiled_and_none_crashes_when_interrupted() -> None:
    done = subprocess.run([sys.executable, "-c", LOOK_AT_KERNELS], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["fusion", "map", "sim"]


def test_only_the_named_packages_are_compiled(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim"]) == 0
    assert [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()] == ["sim"]
    with pytest.raises(SystemExit):
        main(["wall"])
    assert "fusion, map, sim" in capsys.readouterr().err
