"""Decimal numbers in text."""

from __future__ import annotations

import math

import pytest

from egvs.core.numbers import parse_decimal


@pytest.mark.parametrize("text", ["7", "-1.5", "+.5e-3", " 8e3\t", "1.7976931348623157e308", "-0.1"])
def test_reads_what_float_reads(text: str) -> None:
    assert parse_decimal(text) == float(text)


def test_reads_missing_and_infinite_values() -> None:
    assert math.isnan(parse_decimal("nan"))
    assert parse_decimal("-inf") == -math.inf


@pytest.mark.parametrize("text", ["", "1_0", "1,5", "0x10", "\u0661\u0660", "\uff11", "\u22121", "ten"])
def test_rejects_other_notations(text: str) -> None:
    with pytest.raises(ValueError):
        parse_decimal(text)
