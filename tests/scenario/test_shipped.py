"""The scenarios that come with the program are found by name."""

from __future__ import annotations

import pytest

import egvs


def test_unknown_scenario_lists_known_ones() -> None:
    with pytest.raises(egvs.InputError, match=r"scenario: expected one of demo, hill, .*roundabout, got 'roundabuot'"):
        egvs.shipped_scenario("roundabuot")


@pytest.mark.parametrize("name", ["..", "demo/..", ""])
def test_name_is_no_path(name: str) -> None:
    with pytest.raises(egvs.InputError, match="expected one of"):
        egvs.shipped_scenario(name)
