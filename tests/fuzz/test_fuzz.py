"""Every input of the corpus once more, and a minute of fuzzing shared by all targets; `make soak` takes longer."""

import os
import random
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from tests.fuzz.make_corpus import seeds
from tests.fuzz.one_target import CORPUS, FOUND
from tests.fuzz.soak import FINDINGS, ROOT, SoakReport, soak
from tests.fuzz.targets import TARGETS, survives
from tests.fuzz.wrapping_mutator import bytewise

SECONDS = 60 // len(TARGETS) - 2
"""Of each target, after some two seconds for starting and ending."""
JOBS = 2

GREEDY_TARGET = """
import sys
from pathlib import Path
from tests.fuzz.one_target import MEMORY_BYTES_MAX, fuzz
from tests.fuzz.targets import Target

def greedy(data: bytes) -> None:
    if len(data) > 64:
        bytearray(2 * MEMORY_BYTES_MAX)

seeds, grown, findings = map(Path, sys.argv[1:])
fuzz(Target(greedy), seeds, seconds=60, grown=grown, findings=findings)
"""

needs_atheris = pytest.mark.skipif(
    find_spec("atheris") is None, reason="atheris is not installed: it has wheels for Linux on x86-64 only"
)
every_target = pytest.mark.parametrize("name", TARGETS)


@every_target
def test_every_input_of_the_corpus_is_refused_or_gives_something_sound(name: str) -> None:
    for path in sorted((CORPUS / name).glob("*.input")):
        try:
            survives(TARGETS[name], path.read_bytes())
        except BaseException as exc:
            exc.add_note(f"on {path}")
            raise


def test_every_target_has_seeds_and_every_seed_a_target() -> None:
    folders = {path.parent.name for path in CORPUS.glob("*/*.input")}
    assert folders == set(TARGETS) == {target for target, _, _ in seeds()}


def test_every_seed_is_sound_today() -> None:
    assert [(target, name) for target, name, data in seeds() if not survives(TARGETS[target], data)] == []


@every_target
def test_mutators_get_past_checksums(name: str) -> None:
    target, rng = TARGETS[name], random.Random(7)
    if target.mutated is None:
        pytest.skip("has no mutator of its own")
    sound = [data for other, _, data in seeds() if other == name]
    made = [target.mutated(rng.choice(sound), rng, bytewise(rng)) for _ in range(100)]
    taken = [data for data in made if survives(target, data)]
    assert len(set(taken) - set(sound)) >= 5


@pytest.fixture(scope="module")
def reports() -> dict[str, SoakReport]:
    return {report.target: report for report in soak(list(TARGETS), seconds=SECONDS, jobs=JOBS, findings=FINDINGS)}


@pytest.mark.fuzz
@needs_atheris
@every_target
def test_a_short_fuzz_finds_nothing(reports: dict[str, SoakReport], name: str) -> None:
    report = reports[name]
    assert not report.failure, f"{report.failure}\n{report.how_to_repeat}"
    assert report.inputs > 0


@pytest.mark.fuzz
@needs_atheris
def test_too_much_memory_is_a_finding(tmp_path: Path) -> None:
    folders = seeds, _, findings = tmp_path / "seeds", tmp_path / "grown", tmp_path / "findings"
    for folder in folders:
        folder.mkdir()
    (seeds / "short").write_bytes(bytes(64))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", GREEDY_TARGET, *map(str, folders)]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == FOUND
    assert "MemoryError" in done.stdout
    (found,) = findings.iterdir()
    assert len(found.read_bytes()) > 64
