"""A digest depends on content alone."""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from catalog.digests import canonical_json, digest_file, digest_text
from catalog.errors import IdentityError

JSON_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@dataclass(frozen=True)
class Inner:
    rate: float = 0.1
    shifts_m: tuple[float, ...] = (2.0, 3.0)


@dataclass(frozen=True)
class Outer:
    steps: int = 3
    inner: Inner = field(default_factory=Inner)


@given(st.dictionaries(st.text(), JSON_VALUES, max_size=5))
def test_order_of_keys_does_not_matter(mapping):
    backwards = dict(reversed(mapping.items()))
    assert canonical_json(mapping) == canonical_json(backwards)


def test_dataclasses_are_hashed_by_field():
    assert canonical_json(Outer()) == '{"inner":{"rate":0.1,"shifts_m":[2.0,3.0]},"steps":3}'


def test_models_that_hold_dataclasses_are_hashed_by_field():
    class Parameters(BaseModel):
        fit: Outer = Outer()

    assert canonical_json(Parameters()) == canonical_json({"fit": Outer()})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object(), {1: 2}, Outer, len])
def test_what_has_no_canonical_form_is_refused(value):
    with pytest.raises(IdentityError):
        canonical_json({"value": value})


def test_another_process_computes_the_same_digest():
    command = "from catalog.digests import *; print(digest_text(canonical_json({'a': {3, 1, 2}})))"
    root = Path(__file__).resolve().parents[2]
    answer = subprocess.check_output([sys.executable, "-c", command], text=True, cwd=root)
    assert answer.strip() == digest_text(canonical_json({"a": {1, 2, 3}}))


def test_file_digest_is_the_sha256_of_its_bytes(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert digest_file(tmp_path / "file") == expected
