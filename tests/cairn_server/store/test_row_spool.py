"""Encoded cells on their way to the store: those of a dictionary, in bounded memory."""

import pickle
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from cairn_map.evidence.fingerprint import ZERO
from cairn_map.evidence.grid import CellKey
from cairn_server.store.row_spool import ROW_BYTES, RowSpool, remove_spools
from cairn_server.store.store_rows import CellRow


def row_of(key: int, size_bytes: int, lm: int = 0) -> CellRow:
    body = bytes([lm % 256]) * size_bytes
    return CellRow(key=CellKey(key), lm=lm, digest=b"", fingerprint=ZERO, voxels=0, body=body, size_bytes=size_bytes)


CHANGES = st.lists(st.tuples(st.integers(0, 9), st.none() | st.integers(0, 3000)), max_size=40)


@given(CHANGES, st.sampled_from([0, 4000, 1 << 20]))
def test_it_holds_the_rows_of_a_dictionary(changes: list[tuple[int, int | None]], memory_bytes: int) -> None:
    spool, plain = RowSpool(memory_bytes=memory_bytes), dict[int, CellRow]()
    for lm, (key, size_bytes) in enumerate(changes):
        if size_bytes is None:
            spool.drop(CellKey(key))
            plain.pop(key, None)
        else:
            plain[key] = row_of(key, size_bytes, lm)
            spool.put(plain[key])
        assert spool._rows_bytes <= max(memory_bytes, 0)
        assert all(spool.get(CellKey(key)) == plain.get(key) for key in range(10))
    assert list(spool) == [plain[key] for key in sorted(plain)]
    assert [key for key in range(10) if key in spool] == sorted(plain)
    assert len(spool) == len(plain)
    assert list(pickle.loads(pickle.dumps(spool))) == list(spool)


def test_its_file_goes_with_it(tmp_path: Path) -> None:
    spool = RowSpool(tmp_path, memory_bytes=8_000_000)
    for key in range(3):
        spool.put(row_of(key, 5_000_000, key))
    assert len(list(tmp_path.iterdir())) == 1
    assert spool._rows_bytes <= 5_000_000 + ROW_BYTES + 1
    assert [row.lm for row in spool] == [0, 1, 2]
    del spool
    assert not list(tmp_path.iterdir())


def test_files_of_processes_that_were_killed_are_removed(tmp_path: Path) -> None:
    (tmp_path / "fold-abc.rows").write_bytes(b"x")
    (tmp_path / "cairn.sqlite").write_bytes(b"x")
    remove_spools(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["cairn.sqlite"]
