"""One target fuzzed in this process, or one input given to it.

    $ python -m tests.fuzz.one_target cell tests/fuzz/findings/cell-0123456789ab.input
    refused

A finding is read again without atheris; the environment says how kernels run. `each_target.py` fuzzes.
"""

import argparse
import hashlib
import os
import random
import resource
import sys
import traceback
import warnings
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from tests.fuzz.targets import Target

CORPUS = Path(__file__).parent / "corpus"
PACKAGES = ("cairn_map", "cairn_calib", "cairn_fusion", "cairn_client", "cairn_sim")
FOUND, BROKEN = 77, 70
"""Exit codes: a finding, as libFuzzer's own; an error of the fuzzing itself."""
START_OF_ERROR = "=== uncaught"
GROWTH_BYTES = 64
INPUT_BYTES_MAX = 1 << 14
INPUT_S_MAX = 10
"""Wall time of one input; most take less than a millisecond, and a machine may be busy."""
MEMORY_BYTES_MAX = 1 << 30
"""That inputs may take beside what the libraries have taken already; more is a MemoryError, and so a finding."""


def main() -> None:
    """Read one input."""
    from tests.fuzz.targets import TARGETS, survives

    parser = argparse.ArgumentParser("python -m tests.fuzz.one_target", description=__doc__)
    parser.add_argument("target")
    parser.add_argument("input", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("error")
    taken = survives(TARGETS[given.target], given.input.read_bytes())
    sys.stdout.write("taken\n" if taken else "refused\n")


def instrumented_targets() -> "dict[str, Target]":
    """Every target, over packages that tell libFuzzer what they run; they must not have been imported before."""
    from atheris.import_hook import HookManager

    for package in PACKAGES:
        folder = Path(import_module(package).__path__[0])
        for path in sorted(folder.rglob("*_kernels.py")):  # first, since Numba compiles no instrumented code
            import_module(".".join(path.relative_to(folder.parent).with_suffix("").parts))
    # As `instrument_imports`, but comparisons are left alone: their hook keeps every array that one gives, for ever.
    with HookManager(set(PACKAGES), set(), enable_loader_override=True, trace_dataflow=False):
        from tests.fuzz.targets import TARGETS
    return TARGETS


def read_seeds(target: "Target", seeds: Path) -> None:
    """Compiles kernels and builds tables, which must not count as slow."""
    from tests.fuzz.targets import survives

    for path in sorted(seeds.iterdir()):
        survives(target, path.read_bytes())


def fuzz(target: "Target", seeds: Path, *, seconds: int, grown: Path, findings: Path) -> None:
    """Never returns: libFuzzer ends the process, with 0 where nothing was found."""
    import atheris
    from tests.fuzz.targets import survives

    warnings.simplefilter("error")
    read_seeds(target, seeds)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY_BYTES_MAX,) * 2)

    def one_input(data: bytes) -> None:
        try:
            survives(target, data)
        except BaseException:  # noqa: BLE001 (a finding, whatever it is)
            # Not left to atheris: its way out runs exit handlers, and may hang in those of native libraries.
            name = f"crash-{hashlib.sha256(data).hexdigest()[:12]}"
            (findings / name).write_bytes(data)
            _end(FOUND)

    def other_input(data: bytes, max_size: int, seed: int) -> bytes:
        def bytewise(part: bytes) -> bytes:
            return bytes(atheris.Mutate(part, len(part) + GROWTH_BYTES))

        try:
            made = target.mutated(data, random.Random(seed), bytewise) if target.mutated else bytewise(data)
        except BaseException:  # noqa: BLE001 (atheris would hang)
            _end(BROKEN)
        return made if len(made) <= max_size else data

    arguments = [
        f"-max_total_time={seconds}",
        f"-max_len={INPUT_BYTES_MAX}",
        f"-timeout={INPUT_S_MAX}",
        f"-rss_limit_mb={4 * MEMORY_BYTES_MAX >> 20}",
        f"-artifact_prefix={findings}/",
        "-print_final_stats=1",
        "-close_fd_mask=2",  # what native libraries say of each bad image
        str(grown),
        str(seeds),
    ]
    own_mutator = {"custom_mutator": other_input} if target.mutated else {}
    atheris.Setup([sys.argv[0], *arguments], one_input, **own_mutator)
    atheris.Fuzz()


def _end(code: int) -> NoReturn:
    """End the process at once, with the traceback of the error at hand."""
    sys.stdout.write(f"{START_OF_ERROR}\n{traceback.format_exc()}")
    sys.stdout.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
