"""A cursor proves its history and has one text."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cairn_map.commits.cursor import ENTRY_FOLD, ENTRY_UNFOLD, Cursor, cursor_from_text, first_chain, next_chain
from cairn_map.commits.ids import commit_id_from_text
from cairn_map.errors import BadInputError

ID = commit_id_from_text("mole.0123456789abcdef.4")
SHA = bytes(32)
CURSORS = st.builds(
    Cursor, st.binary(min_size=16, max_size=16), st.integers(0, (1 << 63) - 1), st.binary(min_size=16, max_size=16)
)


@given(CURSORS)
def test_a_cursor_comes_back_from_its_text(cursor: Cursor) -> None:
    assert cursor_from_text(str(cursor)) == cursor


A, B = "0a" * 16, "ff" * 16


@pytest.mark.parametrize(
    "text",
    [
        "",
        f"{A}.1",
        f"{A}.1.{B}.2",
        f"{A}.-1.{B}",
        f"{A}.01.{B}",
        f"{A}.1_0.{B}",
        f"{A}.٣.{B}",
        f"{A}..{B}",
        f"{A}.{1 << 63}.{B}",
        f"{A.upper()}.1.{B}",
        f"0a {A[2:]}.1.{B}",
        f"{A}.1.{B}\n",
        f"{A[2:]}.1.{B}",
        f"{A}.{'9' * 5000}.{B}",
        f"{A}.1.{'é' * 32}",
    ],
)
def test_other_texts_are_no_cursor(text: str) -> None:
    with pytest.raises(BadInputError) as refused:
        cursor_from_text(text)
    assert refused.value.kind == "bad_cursor"


def test_the_chain_is_that_of_the_format() -> None:
    start = first_chain(b"l" * 16, b"g" * 32)
    assert start == hashlib.sha256(b"cairn-chain-0" + b"l" * 16 + b"g" * 32).digest()[:16]
    entry = start + b"+" + b"mole.0123456789abcdef.4" + b"\0" + SHA
    assert next_chain(start, ENTRY_FOLD, ID, SHA) == hashlib.sha256(entry).digest()[:16]


def test_every_part_of_the_history_changes_the_chain() -> None:
    start = first_chain(b"l" * 16, b"g" * 32)
    other = commit_id_from_text("mole.0123456789abcdef.5")
    chains = {
        next_chain(start, ENTRY_FOLD, ID, SHA),
        next_chain(start, ENTRY_UNFOLD, ID, SHA),
        next_chain(start, ENTRY_FOLD, other, SHA),
        next_chain(start, ENTRY_FOLD, ID, b"x" * 32),
        next_chain(first_chain(b"m" * 16, b"g" * 32), ENTRY_FOLD, ID, SHA),
        next_chain(first_chain(b"l" * 16, b"h" * 32), ENTRY_FOLD, ID, SHA),
    }
    assert len(chains) == 6
