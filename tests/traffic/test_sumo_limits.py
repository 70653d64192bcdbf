"""Programs of SUMO have limits of memory and time, and demand has a limit of vehicles before SUMO reads it.

Each message names the limit, and the variable that raises it.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.stages import traffic
from egvs.traffic import sumo, user_files
from egvs.traffic.user_files import DemandFiles
from tests.stage_runner import run_stage
from tests.traffic.helpers import SMALL, fake_sumo, first_lane, scenario

NO_VEHICLES = limits.Limit("EGVS_MAX_VEHICLES", 0, "vehicles", "the vehicles and people that route files let depart")
LINUX = sys.platform.startswith("linux")


@pytest.mark.slow
@pytest.mark.skipif(not LINUX, reason="elsewhere the processor time of other processes is not known")
def test_idle_sumo_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_sumo(tmp_path, monkeypatch, "exec sleep 1000")
    monkeypatch.setenv(limits.SUMO_IDLE.name, "1")
    message = r"^sumo has neither worked nor written anything for 1 s\. The limit is 1 s; set EGVS_MAX_SUMO_IDLE_S to"
    with pytest.raises(sumo.SumoInputError, match=message):
        sumo.run_program("sumo", [], tmp_path)


@pytest.mark.slow
def test_sumo_that_writes_is_not_idle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_sumo(tmp_path, monkeypatch, "for i in 1 2 3 4 5; do sleep 1; echo >> output; done; echo done")
    monkeypatch.setenv(limits.SUMO_IDLE.name, "3")
    assert sumo.run_program("sumo", [], tmp_path) == "done\n"


@pytest.mark.slow
@pytest.mark.skipif(not LINUX, reason="elsewhere the launcher is limited, which starts the program")
def test_sumo_has_a_limit_of_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_sumo(tmp_path, monkeypatch, "while :; do :; done")
    monkeypatch.setenv(limits.SUMO_TIME.name, "1")
    message = r"^sumo worked for more than 3 s\. The limit is 1 s; set EGVS_MAX_SUMO_S to raise it\.$"
    with pytest.raises(sumo.SumoInputError, match=message):
        sumo.run_program("sumo", [], tmp_path, time_steps=2)


@pytest.mark.slow
@pytest.mark.skipif(not LINUX, reason="only Linux limits the memory of a process")
def test_sumo_has_a_limit_of_memory(town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The real program, with vehicles that wait to depart."""
    edge = first_lane(town / "net.xml")[0]
    shutil.copy(town / "net.xml", tmp_path)
    flow = f'<flow id="f" begin="0" end="60" number="1000000000"><route edges="{edge}"/></flow>'
    (tmp_path / "r.rou.xml").write_text(f"<routes>{flow}</routes>")
    monkeypatch.setenv(limits.SUMO_MEMORY.name, "300")
    message = r"^sumo needed more than 300 MB of memory\. The limit is 300 MB; set EGVS_MAX_SUMO_MB to raise it\.$"
    with pytest.raises(sumo.SumoInputError, match=message):
        sumo.run_program("sumo", ["-n", "net.xml", "-r", "r.rou.xml", "--end", "10"], tmp_path)


def test_allowance_grows_with_input(tmp_path: Path) -> None:
    (tmp_path / "net.xml").write_bytes(bytes(3_900_000))
    assert sumo.Allowance.for_input(tmp_path, 50) == sumo.Allowance(memory_mb=2060, work_s=680)


def departures(folder: Path, *elements: str, scale: str = "1") -> float:
    """Return how many vehicles depart from 100 s to 200 s: the smallest limit that does not reject them."""
    path = folder / "r.rou.xml"
    path.write_text(f"<routes>{''.join(elements)}</routes>")
    inputs = DemandFiles({"route-files": (path,)}, {"scale": scale})
    try:
        user_files.check_demand_size(inputs, 100.0, 200.0)
    except InputError as error:
        return float(error.problem.split()[0].replace(",", ""))
    return 0.0


@pytest.mark.parametrize(
    ("elements", "expected"),
    [
        (['<flow begin="0" end="1000" number="1000000"/>'], 100_000),
        (['<flow begin="150" end="0:2:40" number="500"/>'], 500),
        (['<flow begin="150" end="250" number="500"/>'], 250),
        (['<flow begin="200" end="900" number="1000000000"/>'], 0),
        (['<flow number="30"/>'], 30),
        (['<flow begin="0" vehsPerHour="3600"/>'], 100),
        (['<flow begin="0" period="0.5"/>'], 200),
        (['<flow begin="0" period="exp(3)"/>'], 300),
        (['<flow begin="0" probability="0.5"/>'], 50),
        (['<flow begin="0" period="0.5" number="60"/>'], 60),
        (['<personFlow begin="0" personsPerHour="7200"/>', '<containerFlow perHour="3600"/>'], 300),
        (['<vehicle depart="120"/>', '<trip depart="0:2:00"/>', '<person depart="now"/>'], 3),
        (['<vehicle depart="300"/>', '<vehicle depart="99"/>', '<vehicle depart="100"/>'], 1),
        (['<calibrator><flow begin="0" end="900" vehsPerHour="36000"/></calibrator>'], 1000),
        (['<flow begin="0" number="many"/>', '<flow period="-1"/>', '<flow begin="0" end="-5" number="7"/>'], 0),
    ],
)
def test_counts_departures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, elements: list[str], expected: float
) -> None:
    monkeypatch.setattr(limits, "VEHICLES", NO_VEHICLES)
    assert departures(tmp_path, *elements) == expected
    assert departures(tmp_path, *elements, scale="2") == 2 * expected


def test_limit_of_vehicles_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.rou.xml"
    path.write_text('<routes><flow begin="0" end="60" number="1000000000"/></routes>')
    message = (
        r"r\.rou\.xml: 1,000,000,000 vehicles and people depart in 60 s\. The limit is 1,000,000 vehicles; set EGVS"
    )
    with pytest.raises(InputError, match=message):
        user_files.check_demand_size(DemandFiles({"route-files": (path,)}), 0.0, 60.0)


def test_limit_of_edges_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.rou.xml"
    path.write_text('<routes><vehicle depart="0"><route id="r" edges="a b" repeat="100000000"/></vehicle></routes>')
    message = (
        r"r\.rou\.xml: route r: has 200,000,002 edges with repeat=1e\+08\. The limit is 1,000,000 edges; set EGVS_"
    )
    with pytest.raises(InputError, match=message):
        user_files.check_demand_size(DemandFiles({"additional-files": (path,)}), 0.0, 60.0)


def test_traffic_stage_does_not_start_too_many_vehicles(town: Path, tmp_path: Path) -> None:
    edge = first_lane(town / "net.xml")[0]
    flow = f'<flow id="f" begin="0" end="60" number="1000000000"><route edges="{edge}"/></flow>'
    routes = tmp_path / "r.rou.xml"
    routes.write_text(f"<routes>{flow}</routes>")
    keys = {key: value for key, value in SMALL.items() if key in ("frames", "warmup_s")}
    with pytest.raises(InputError, match=r"r\.rou\.xml: 1,000,000,000 vehicles and people depart in 120 s"):
        run_stage(traffic, scenario(town, network="net.xml", routes=[str(routes)], **keys), tmp_path / "out")
