"""FORMAT.md says what the code does: its example, byte by byte, and its limits."""

import re
from pathlib import Path

import numpy as np
import pytest
from tests.fixtures.map.made import as_dict
from tests.naive import cell_code as naive_cell_code

from cairn_map.codec import cell_reading
from cairn_map.codec.cell_code import encode_cell
from cairn_map.codec.octree import streams
from cairn_map.commits import commit, ids, version_vector
from cairn_map.commits.commit import CommitMeta, make_commit
from cairn_map.evidence.channels import TEMPERATURE
from cairn_map.evidence.evidence import Evidence, packed_evidence
from cairn_map.evidence.fingerprint import fingerprint
from cairn_map.evidence.grid import Geometry, cell_key
from cairn_map.wire import frames

DOCUMENT = (Path(__file__).parents[2] / "fusion" / "FORMAT.md").read_text()
LINE = re.compile(r"^    ([0-9a-f]{4})  ((?:[0-9a-f]{2} )+) ", re.MULTILINE)
GEOMETRY = Geometry(voxel_edge_um=50_000, depth=3, channels=(TEMPERATURE,))
KEY = cell_key((-1, 0, 2))


def example() -> Evidence:
    """The evidence of FORMAT.md section 13."""
    places = np.array([*range(8, 16), 511], np.uint32)
    counts = np.array([[0, 1]] * 8 + [[2, 0]])
    samples = np.array([[0, 0, 0]] * 8 + [[5863 + 5865, 5863**2 + 5865**2, 2]])
    return packed_evidence(places, counts, samples, GEOMETRY)


def test_the_bytes_in_the_document_are_what_the_code_writes() -> None:
    written = bytes.fromhex("".join(found[2] for found in LINE.finditer(DOCUMENT)))
    assert written == encode_cell(KEY, example(), GEOMETRY).data
    assert naive_cell_code.decode_cell(written)[1] == as_dict(example())


def test_the_offsets_in_the_document_are_those_of_its_bytes() -> None:
    at = 0
    for found in LINE.finditer(DOCUMENT):
        assert int(found[1], 16) == at
        at += len(bytes.fromhex(found[2]))


def test_the_digests_in_the_document_are_those_of_the_code() -> None:
    cell = encode_cell(KEY, example(), GEOMETRY)
    made = make_commit(
        CommitMeta(id="mole.0123456789abcdef.0", geometry=GEOMETRY.digest().hex()), {KEY: example()}, GEOMETRY
    )
    for name, text in {
        "cell number": str(KEY),
        "digest": cell.digest.hex(),
        "fingerprint": fingerprint(example(), KEY).hex(),
        "geometry digest": GEOMETRY.digest().hex(),
        "commit SHA-256": made.sha.hex(),
    }.items():
        assert re.search(rf"^    {name} +{text}$", DOCUMENT, re.MULTILINE), name


@pytest.mark.parametrize(
    ("row", "numbers"),
    [
        ("cell file", [cell_reading.CELL_BYTES_MAX]),
        ("raw bytes of a cell's streams, together", [streams.RAW_BYTES_MAX]),
        ("zstd window", [streams.ZSTD_WINDOW_MAX]),
        ("packed evidence of a cell", [cell_reading.EVIDENCE_BYTES_MAX]),
        ("commit", [commit.COMMIT_BYTES_MAX, commit.CELLS_MAX, commit.META_BYTES_MAX]),
        ("packed evidence of a commit", [commit.EVIDENCE_BYTES_MAX]),
        ("bricks (8^3 voxels) that a commit touches", [commit.BRICKS_MAX]),
        ("the same, for B bytes of commit", [commit.EVIDENCE_ALLOWANCE_BYTES, commit.EVIDENCE_PER_BYTE]),
        ("scans, retracts", [commit.RETRACTS_MAX]),
        ("frame body", [1 << 28, frames.FRAME_BYTES_MAX - (1 << 28), frames.JSON_BYTES_MAX]),
        (
            "version vector",
            [version_vector.AUTHORS_MAX, version_vector.INTERVALS_MAX, version_vector.COMMITS_MAX],
        ),
        ("n of a commit", [ids.NUMBER_LIMIT]),
    ],
)
def test_the_limits_in_the_document_are_those_of_the_code(row: str, numbers: list[int]) -> None:
    limits = DOCUMENT.split("## 11. Limits")[1].split("## 12.")[0]
    cells = next(line.split("|") for line in limits.splitlines() if line.startswith(f"| {row}"))
    written = [eval(text.replace("^", "**").replace(" ", "")) for text in re.findall(r"\d+\^\d+|\d[\d ]*\d", cells[2])]
    assert written[: len(numbers)] == numbers
