"""Is the roundabout scenario's network what its sources give, and does its traffic flow in the circle?"""

import re
import shutil
from pathlib import Path

import numpy as np

from egvs.artefacts import parquet
from egvs.scenario.loading import load
from egvs.stages import traffic
from egvs.traffic import sumo
from tests.stage_runner import run_stage

ROUNDABOUT = Path(__file__).resolve().parents[2] / "scenarios" / "roundabout"


def test_the_sources_give_the_committed_network(tmp_path):
    for source in (ROUNDABOUT / "network").iterdir():
        shutil.copy(source, tmp_path)
    words = (ROUNDABOUT / "network" / "README.md").read_text().partition("    netconvert ")[2].partition("\n\n")[0]
    arguments = words.replace("\\", " ").replace("../network.net.xml", "made.net.xml").split()
    sumo.run_program("netconvert", arguments, tmp_path)
    made = [
        re.sub(r"<!--.*?-->", "", text, flags=re.S).split()
        for text in ((tmp_path / "made.net.xml").read_text(), (ROUNDABOUT / "network.net.xml").read_text())
    ]
    assert made[0] == made[1]


def test_traffic_is_held_and_goes_round_counter_clockwise(tmp_path):
    scene = load(ROUNDABOUT, ["traffic.frames=120", "traffic.warmup_s=100", "tpog.blocks=1"])
    result = run_stage(traffic, scene, tmp_path)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 28 and result["collisions"] == 0
    rows = parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")[0]
    x, y, yaw = (rows[name].to_numpy() for name in ("x_m", "y_m", "yaw_rad"))
    from_middle_m = np.hypot(x, y)
    assert from_middle_m.min() > 14  # nobody on the island
    circling = from_middle_m < 18
    assert circling.sum() > 200
    counter_clockwise = x * np.sin(yaw) - y * np.cos(yaw) > 0  # right-hand traffic
    assert counter_clockwise[circling].all()
