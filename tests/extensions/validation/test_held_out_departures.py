"""Held-out traffic of a user's demand: vehicles depart at other times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.artefacts.traffic_frames import read_trajectories
from egvs.extensions.validation import held_out_traffic
from egvs.scenario.model import Scenario
from egvs.stages import traffic
from tests.stage_runner import run_stage
from tests.traffic.helpers import netgenerate, scenario
from tests.traffic.test_departures import write_demand


@pytest.mark.slow
@pytest.mark.parametrize(
    "demand",
    [
        [f"<vehicle id='{k}' route='r' depart='{4 * k}'/>" for k in range(75)],
        ["<flow id='f' route='r' begin='0' end='300' period='4'/>"],
    ],
)
def test_vehicles_of_held_out_traffic_depart_at_other_times(tmp_path: Path, demand: list[str]) -> None:
    netgenerate(tmp_path, "--grid", "--grid.number", "2", "--grid.length", "150")
    write_demand(tmp_path, "<route id='r' edges='A0B0 B0B1 B1A1'/>", *demand)
    files = '<net-file value="net.xml"/><route-files value="d.rou.xml"/>'
    (tmp_path / "own.sumocfg").write_text(f"<configuration>{files}</configuration>")
    times = {"frames": 250, "warmup_s": 0.0, "step_s": 1.0, "frame_period_s": 1.0}
    trained = scenario(tmp_path, sumocfg="own.sumocfg", **times)
    held_out = held_out_traffic.held_out_scenario(trained, 250, 1.0)
    other_seed = trained.model_copy(update={"seed": held_out.seed})

    fixed = start_frames(tmp_path / "fixed", other_seed)
    redrawn = start_frames(tmp_path / "redrawn", held_out)
    assert np.mean(fixed % 4 == 0) > 0.9
    assert np.mean(redrawn % 4 == 0) < 0.5
    assert len(redrawn) == pytest.approx(len(fixed), rel=0.35)


def start_frames(folder: Path, recorded: Scenario) -> np.ndarray:
    """Record traffic; return the first frame of each vehicle."""
    run_stage(traffic, recorded, folder)
    rows = read_trajectories(folder / "trajectories.parquet")
    starts: dict[str, int] = {}
    for frame, vehicle in zip(rows["frame"].to_pylist(), rows["vehicle"].to_pylist(), strict=True):
        starts.setdefault(vehicle, frame)
    return np.array(list(starts.values()))
