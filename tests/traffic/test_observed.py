"""Observed queues and speeds: the file, and the comparison in run and report."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from egvs.core.errors import InputError
from egvs.scenario import loading
from egvs.stages import check
from egvs.traffic import observed
from egvs.traffic.approaches import ApproachIndex
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import read_net_xml
from tests.creation.new_scenarios import create_scenario
from tests.creation.overpass_server import SMALL

APPROACHES = ["North Street (north)", "East Street (east)", "North Street (south)", "East Street (west)"]


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario with counts on all four approaches."""
    folder = tmp_path_factory.mktemp("observed")
    (folder / "c.csv").write_text("approach,count\nN,200\nS,200\nE,300\nW,300\n")
    create_scenario(folder / "cross", SMALL, counts=folder / "c.csv")
    return folder / "cross"


@pytest.fixture(scope="module")
def index(crossing: Path) -> ApproachIndex:
    scenario = loading.load(crossing)
    names = MovementNames(read_net_xml(crossing / "network.net.xml"), scenario.roi.center_m[:2])
    return ApproachIndex.of_flows(scenario.traffic.counts, names)


def read(tmp_path: Path, index: ApproachIndex, *lines: str, periods: tuple[str, ...] = ()) -> Any:
    (tmp_path / "o.csv").write_text("\n".join(lines) + "\n")
    return observed.read_observations(tmp_path / "o.csv", index, periods)


@pytest.mark.slow
def test_approaches_are_named_as_in_counts(tmp_path: Path, index: ApproachIndex) -> None:
    assert index.titles == APPROACHES
    lines = "street,approach,queue_m,speed_kmh", "North St,N,40,", ",westbound,,22", ",S,0,12.5"
    rows = read(tmp_path, index, *lines)
    assert [(row.approach, row.queue_m, row.speed_kmh) for row in rows] == [
        ("North Street (north)", 40.0, None), ("East Street (east)", None, 22.0), ("North Street (south)", 0.0, 12.5),
    ]  # fmt: skip


HEAD = "approach,queue_m,speed_kmh"
BAD = {
    "empty": (["approach"], r"header: expected approach or street, and queue_m or speed_kmh"),
    "unknown column": (["approach,queue", "N,1"], r"header: unknown column 'queue'"),
    "no rows": ([HEAD], r"o.csv: has no observations"),
    "unknown approach": (["street,queue_m", "High St,4"], r"line 2: no approach of the junction is called 'High St'"),
    "ambiguous": (
        ["street,queue_m", "North St,4"],
        r"line 2: 'North St' may be North Street \(north\) or North Street \(south",
    ),
    "no side": (
        [HEAD, "up,3,4"],
        r"line 2: approach: expected the side on which .* got 'up'",
    ),
    "nothing observed": ([HEAD, "N,,"], r"line 2: has neither queue_m nor speed_kmh"),
    "no number": ([HEAD, "N,long,"], r"line 2: queue_m: expected a number of 0 to 10,000, got 'long'"),
    "negative": ([HEAD, "N,,-1"], r"line 2: speed_kmh: expected a number of 0 to 300, got '-1'"),
    "twice": ([HEAD, "N,1,", "southbound,2,"], r"line 3: two rows for the approach North Street \(north\)"),
    "period": (["approach,period,queue_m", "N,morning,3"], r"line 2: period: .* The scenario has no periods"),
    "few values": ([HEAD, "N,3"], r"line 2: expected 3 values"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_observations_give_one_message(name: str, tmp_path: Path, index: ApproachIndex) -> None:
    lines, expected = BAD[name]
    with pytest.raises(InputError, match=expected):
        read(tmp_path, index, *lines)


def test_scenario_with_periods_needs_them_in_the_file(tmp_path: Path, index: ApproachIndex) -> None:
    periods = ("07-08", "08-09")
    (row,) = read(tmp_path, index, "approach,period,queue_m", "N,07-08,3", periods=periods)
    assert row.period == "07-08"
    with pytest.raises(InputError, match=r"expected a period of the scenario, got ''. Periods: 07-08, 08-09"):
        read(tmp_path, index, HEAD, "N,3,", periods=periods)


@pytest.mark.slow
def test_check_reports_a_bad_file_and_missing_counts(crossing: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text(f"{HEAD}\nX,1,2\n")
    overrides = [f"traffic.observed='{tmp_path / 'bad.csv'}'"]
    (error,) = check.check_scenario(loading.load(crossing, overrides)).errors
    assert "bad.csv: line 2: approach: expected the side" in str(error)
    (error,) = check.check_scenario(loading.load(crossing, [*overrides, "traffic.counts=[]"])).errors
    assert "scenario.toml: traffic.observed: needs counted traffic in every period" in str(error)


@pytest.mark.slow
def test_run_and_report_compare_queues(crossing: Path, tmp_path: Path, run_egvs: Any) -> None:
    (tmp_path / "o.csv").write_text(f"{HEAD}\nN,40,20\nE,,25\n")
    settings = [
        f"traffic.observed='{tmp_path / 'o.csv'}'", "traffic.frames=100", "traffic.warmup_s=60", "tpog.blocks=2",
        "sites.heights_m=[3]", "sites.pitch_deg=0", "roi.voxel_m=1",
    ]  # fmt: skip
    words = [word for setting in settings for word in ("--set", setting)]
    code, _, error = run_egvs("run", crossing, "--out", tmp_path / "run", *words)
    assert code == 0, error
    text = " ".join(error.split())
    assert re.search(
        r"from North Street \(north\): queue \d+ m \(observed 40 m\), \d+ km/h \(observed 20 km/h\)", text
    ), text
    assert re.search(r"from East Street \(east\): \d+ km/h \(observed 25 km/h\)", text)
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Observed and simulated queues" in page
    for approach in APPROACHES:
        assert approach in page

    (tmp_path / "o.csv").write_text(f"{HEAD}\nN,41,20\n")
    _, _, error = run_egvs("run", crossing, "--out", tmp_path / "run", *words)
    assert "observed 41 m" in " ".join(error.split())
    assert re.search(r"traffic +unchanged", error)
