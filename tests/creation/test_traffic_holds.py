"""Traffic of new scenarios holds with the defaults: no locks, no queues that grow, all flows carried."""

from pathlib import Path

import pytest

from egvs.creation.new_scenario import NewScenario
from egvs.scenario.loading import load
from egvs.stages import traffic
from tests.creation.made_up_towns import write_town
from tests.creation.new_scenarios import create_scenario
from tests.stage_runner import run_stage

SMALL = Path(__file__).parent / "data" / "small.osm"
TOWN = Path(__file__).parents[3] / "shared" / "real" / "bad_hersfeld_town.osm.xml.gz"

LOCKS = {"teleports", "waiting", "counts", "standing"}
"""Rules of warnings about traffic that does not hold."""


def check_traffic(scenario: NewScenario, out: Path, seed: int, frames: int = 1800) -> None:
    overrides = [f"seed={seed}", f"traffic.frames={frames}"]
    result = run_stage(traffic, load(scenario.folder, overrides), out)
    assert result["teleports"] == 0
    assert LOCKS.isdisjoint(warning["rule"] for warning in result["warnings"]), result["warnings"]
    assert all(count["geh"] < 5 for count in result["counts"])


@pytest.mark.slow
@pytest.mark.parametrize("lefthand", [False, True])
def test_small_extract(tmp_path: Path, lefthand: bool) -> None:
    scenario = create_scenario(tmp_path / "new", SMALL, lefthand=lefthand, traffic="heavy")
    check_traffic(scenario, tmp_path / "out", seed=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["grid", *(pytest.param(kind, marks=pytest.mark.nightly) for kind in ("spider", "random"))]
)
def test_made_up_towns(tmp_path: Path, kind: str) -> None:
    at = write_town(tmp_path / "town.osm", kind, seed=1)[0]
    scenario = create_scenario(tmp_path / "new", tmp_path / "town.osm", at)
    check_traffic(scenario, tmp_path / "out", seed=1)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.skipif(not TOWN.is_file(), reason=f"{TOWN.name} is not beside the checkout (shared/real)")
@pytest.mark.parametrize("at", [(50.8621925, 9.719901), (50.8546613, 9.7220179)], ids=["loops", "locks"])
def test_junctions_of_real_town(tmp_path: Path, at: tuple[float, float]) -> None:
    """At the first, half of the vehicles used to pass the signals twice; at the second, short pieces locked."""
    scenario = create_scenario(tmp_path / "new", TOWN, at)
    check_traffic(scenario, tmp_path / "out", seed=1)
