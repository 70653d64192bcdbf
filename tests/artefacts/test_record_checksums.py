"""A record that says its own hash notices any change of what it says, and none of how it is written."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.artefacts.checksums import add_checksum, has_valid_checksum

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.floats() | st.text(st.characters(codec="utf-8")),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(st.characters(codec="utf-8")), inner, max_size=4)
    ),
    max_leaves=12,
)


@pytest.mark.slow
@given(st.dictionaries(st.text(st.characters(codec="utf-8"), min_size=1), VALUES, max_size=5))
def test_added_checksum_is_valid(value: dict[str, Any]) -> None:
    assert has_valid_checksum(json.loads(json.dumps(add_checksum(value))))


def test_any_change_invalidates_the_checksum() -> None:
    record = {
        "stages": {"scan": {"files": {"a": "0"}, "n": 3, "nothing": None}},
        "x": [1.5, math.inf],
        10: "ten",
        9: (),
    }
    text = json.dumps(add_checksum(record), indent=2)
    assert has_valid_checksum(json.loads(text))
    assert has_valid_checksum(json.loads(json.dumps(json.loads(text), sort_keys=True)))
    for old, new in (
        ("3", "4"),
        ("1.5", "1.50001"),
        ("null", "0"),
        ('"0"', "0"),
        ('"a"', '"b"'),
        ("ten", "nine"),
        ("n", "m"),
    ):
        assert old in text
        assert not has_valid_checksum(json.loads(text.replace(old, new, 1)))
    for odd in ([], None, "x", {}, {"own_sha256": None}, {"own_sha256": "0", "a": 1}):
        assert not has_valid_checksum(odd)
