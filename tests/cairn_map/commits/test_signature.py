"""Signatures: anyone can verify the author of a commit, and only the author can sign it."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fixtures.map.made import SMALL

from cairn_map.commits.ids import Author, RobotName
from cairn_map.commits.signature import (
    SIGNATURES_MAX,
    SMALL_ORDER,
    Signature,
    SigningKey,
    are_valid,
    check_signatures,
    incarnation_of,
    signatures_from_text,
    signatures_to_text,
    speaks_for,
)
from cairn_map.errors import BadInputError

KEY, OTHER = SigningKey(bytes(32)), SigningKey(bytes([1] * 32))
SHA = hashlib.sha256(b"a commit").digest()
MOLE = RobotName("mole")


def test_the_numbers_of_a_key_are_those_of_the_document() -> None:
    assert KEY.public_key.hex() == "3b6a27bcceb6a42d62a3a8d02a6f0d73653215771de243a63ac048a18b59da29"  # RFC 8032's way
    assert KEY.incarnation == hashlib.sha256(b"cairn-key-1" + KEY.public_key).hexdigest()[:16]


def test_a_signature_is_good_for_its_commit_its_map_and_its_key_alone() -> None:
    signature = KEY.sign("lab", SHA)
    check_signatures([signature], "lab", SHA)
    for wrong, name, sha in (
        (signature, "yard", SHA),
        (signature, "lab", SMALL.digest()),
        (Signature(OTHER.public_key, signature.mark), "lab", SHA),
        (Signature(bytes(31) + b"\xff", signature.mark), "lab", SHA),
    ):
        with pytest.raises(BadInputError) as refused:
            check_signatures([KEY.sign(name, sha), wrong], name, sha)
        assert refused.value.kind == "bad_signature"


@given(st.integers(0, 511))
def test_no_bit_of_a_mark_can_change(bit: int) -> None:
    key, mark = KEY.sign("lab", SHA)
    changed = bytearray(mark)
    changed[bit // 8] ^= 1 << bit % 8
    with pytest.raises(BadInputError):
        check_signatures([Signature(key, bytes(changed))], "lab", SHA)


def test_a_key_speaks_for_its_own_incarnation_of_any_robot() -> None:
    signed = [KEY.sign("lab", SHA)]
    assert speaks_for(signed, Author(MOLE, KEY.incarnation))
    assert not speaks_for(signed, Author(MOLE, OTHER.incarnation))
    assert incarnation_of(OTHER.public_key) == OTHER.incarnation


def test_signatures_are_read_as_they_are_written() -> None:
    signed = (KEY.sign("lab", SHA), OTHER.sign("lab", SHA))
    assert signatures_from_text(signatures_to_text(signed)) == signed
    assert signatures_from_text(signatures_to_text(signed[:1] * SIGNATURES_MAX)) == signed[:1] * SIGNATURES_MAX


@pytest.mark.parametrize("text", ["", "a.b", "zz", "00" * 32, f"{'00' * 32}.{'00' * 63}", "." * 500, "ü.ü"])
def test_other_texts_are_no_signatures(text: str) -> None:
    with pytest.raises(BadInputError) as refused:
        signatures_from_text(text)
    assert refused.value.kind == "bad_signature"


def test_too_many_signatures_are_not_looked_at() -> None:
    with pytest.raises(BadInputError):
        signatures_from_text(signatures_to_text([KEY.sign("lab", SHA)] * (SIGNATURES_MAX + 1)))


def test_a_key_is_not_shown_by_accident() -> None:
    assert KEY.seed.hex() not in repr(KEY)


def test_a_key_of_small_order_signs_nothing() -> None:
    """With the key 1 and the mark (1, 0) libraries take every message for signed."""
    one = b"\1" + bytes(31)
    for key in SMALL_ORDER:
        for sign in (0, 0x80):
            signed = key[:-1] + bytes([key[-1] | sign])
            for point in (one, key, signed):
                assert not are_valid([Signature(signed, point + bytes(32))], b"anything")
    # The curve's own arithmetic: eight times such a point is the neutral one, (0, 1), and there are no others.
    prime = 2**255 - 19
    d = -121665 * pow(121666, -1, prime) % prime
    found = {int.from_bytes(key, "little") % prime for key in SMALL_ORDER}
    for y in found:
        x2 = (y * y - 1) * pow(d * y * y + 1, -1, prime) % prime
        for _ in range(3):
            # Doubling, in squares: y3 = (y^2 + x^2) / (1 - d x^2 y^2), x3^2 = 4 x^2 y^2 / (1 + d x^2 y^2)^2.
            k = d * x2 * y * y % prime
            y, x2 = (
                (y * y + x2) * pow(1 - k, -1, prime) % prime,
                4 * x2 * y * y * pow((1 + k) ** 2, -1, prime) % prime,
            )
        assert (x2, y) == (0, 1)
    assert len(found) == 5  # y of the eight points: 1, -1, 0 twice, and two of four points each
