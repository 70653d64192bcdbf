"""The section of a run's report on measured sweeps and labels."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.extensions.validation.measured.figures import Panel, Series, range_figure
from egvs.extensions.validation.measured.ratios import Ratio
from tests.extensions.validation.measured import twin, two_sensors
from tests.extensions.validation.measured.test_comparison import LOSSES


@pytest.mark.slow
def test_a_comparison_in_a_run_folder_is_in_its_report(mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    """Of the world of the run, it is shown as long as this world is the same; without a scenario, always."""
    sweeps = tmp_path / "sweeps"
    sweeps.mkdir()
    made = twin.make_twin(LOSSES, seed=5, sweeps=2, cars=8)
    twin.write_pcd(sweeps, made)
    twin.write_openlabel(sweeps, made)
    first, second = two_sensors.make_lists(seed=3, sweeps=20)
    south = two_sensors.write_openlabel(tmp_path / "south", first, two_sensors.POSES[0])
    north = two_sensors.write_openlabel(tmp_path / "north", second, two_sensors.POSES[1])
    pose = twin.POSE
    row = f"mast,-80,40,{pose.z_m},90,{pose.pitch_deg},{pose.roll_deg}"
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg\n{row}\n", encoding="utf-8")
    run = tmp_path / "run"

    def text() -> str:
        return html.unescape((run / "report.html").read_text(encoding="utf-8"))

    assert run_egvs("run", mini, "--out", run)[0] == 0
    assert 'id="measured"' not in text()
    against = ("--against", sweeps, "--labels", sweeps, "--sensor", twin.SENSOR, "--detector", "points")
    code, printed, error = run_egvs("validate", mini, "--site", "mast", *against, "--out", run)
    assert code == 0, error
    assert f"wrote {run / 'report.html'}" in printed
    section = text()[text().index('id="measured"') :]
    assert "simulated / measured points" in section and "16 labelled boxes in 2 sweeps" in section
    assert run_egvs("verify", run)[0] == 0

    code, _, error = run_egvs("validate", "--labels", south, "--labels", north, "--out", run)
    assert code == 0, error
    assert "16 labelled boxes in 2 sweeps" in text() and "Of what north has, what do the labels south have?" in text()

    entries = json.loads((run / "measured.json").read_text(encoding="utf-8"))["entries"]
    assert [list(entry["stages"]) for entry in entries.values()] == [["statics"], []]


def test_figure_has_marks_errors_and_titles() -> None:
    values = {"0-20": Ratio(0.5, 0.1), "20-30": Ratio(0.25, np.nan), "30-40": Ratio(np.nan, np.nan)}
    panel = Panel("share", ("0-20", "20-30", "30-40"), (Series("<found>", values),), in_percent=True)
    svg = range_figure([panel], "A figure.")
    assert svg.count("<circle") == 3  # two values and the legend
    assert svg.count('class="lead"') == 1
    assert "&lt;found&gt;, 0-20 m: 50 %" in svg and "100 %" in svg
