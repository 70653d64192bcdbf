"""The table of what losses of returns change: decisions by scenario and sensor, and its rows."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks import losses

import egvs
from tests.conftest import write_mini

RATED = ["sensors.small.rated_range_m=30", "sensors.small.rated_reflectivity=0.1"]


def test_decision_is_that_of_the_sensor_at_all_sites() -> None:
    demo = egvs.load(losses.SCENARIOS / "demo")
    assert losses.describe_decision(losses.decide(demo)) == "VLP-32C: on (17 of 74 m)"
    assert losses.describe_decision(losses.decide(demo, "Livox Tele-15")) == "Livox Tele-15: off (77 of 74 m)"


@pytest.mark.slow
def test_row_has_shares_without_and_with_losses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scenarios").mkdir()
    write_mini(tmp_path / "scenarios" / "mini")
    monkeypatch.setattr(losses, "SCENARIOS", tmp_path / "scenarios")
    monkeypatch.setattr(losses, "REPEATS", 1)
    row = losses.table_row("mini", RATED, tmp_path / "out")
    _, name, decision, found, noticed, best, rho, cost, _ = (cell.strip() for cell in row.split("|"))
    assert (name, decision) == ("mini", "small: on (7 of 38 m)")
    before, after = (float(share) for share in found.removesuffix(" %").split(" to "))
    assert before > after > 0.0
    assert noticed.endswith(" %") and best and float(rho) <= 1.0 and float(cost) > 0.0
