"""Scenarios of a SUMO configuration, or of a network and route files, with their demand as it is."""

import gzip
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.creation.openstreetmap import street_network
from egvs.formats import osm
from egvs.scenario.loading import load
from egvs.stages import traffic
from tests.creation.new_scenarios import create_scenario
from tests.creation.overpass_server import SMALL
from tests.stage_runner import run_stage

pytestmark = pytest.mark.system

CONFIGURATION = """<configuration>
    <input>
        <net-file value="{}"/><route-files value="cars.rou.xml"/><additional-files value="types.add.xml"/>
    </input>
    <time><begin value="100"/></time>
</configuration>
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A crossing of two streets, with one flow of vans from 100 s on."""
    folder = tmp_path_factory.mktemp("sumo")
    extract = osm.read_osm(SMALL)
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=False)
    network = street_network.build_network(extract, SMALL, flags).text
    (folder / "streets.net.xml").write_text(network, encoding="utf-8")
    (folder / "streets.net.xml.gz").write_bytes(gzip.compress(network.encode()))
    (folder / "types.add.xml").write_text(
        '<additional><vType id="van" vClass="delivery" length="6" width="2" height="2.5"/></additional>'
    )
    flow = '<flow id="f" type="{}" begin="{}" end="900" period="3"><route edges="-1002#1 -1002#0"/></flow>'
    (folder / "cars.rou.xml").write_text(f"<routes>{flow.format('van', 100)}</routes>")
    (folder / "plain.rou.xml").write_text(f"<routes>{flow.format('DEFAULT_VEHTYPE', 0)}</routes>")
    (folder / "run.sumocfg").write_text(CONFIGURATION.format("streets.net.xml"))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "source"),
    [(["run.sumocfg"], "sumocfg"), (["streets.net.xml.gz", "plain.rou.xml"], "routes")],
)
def test_demand_is_used_as_it_is(files: Path, tmp_path: Path, given: list[str], source: str) -> None:
    summary = create_scenario(tmp_path / "made", [files / name for name in given])
    assert summary.junction.title == "signalised junction of East Street and North Street"
    assert summary.traffic.describe().startswith("as in ")
    scenario = load(tmp_path / "made", ["traffic.frames=40", "traffic.warmup_s=60", "traffic.hold='at_most'"])
    assert getattr(scenario.traffic, source)
    assert (scenario.traffic.network is None) == (source == "sumocfg")
    assert not any("traffic" in entry or "signal" in entry for entry in scenario.assumed)
    recorded = run_stage(traffic, scenario, tmp_path / "run")
    assert recorded["vehicles"]["different"] > 5


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        (["run.sumocfg", "cars.rou.xml"], {}, "--from: expected one SUMO configuration, or route files"),
        (["missing.sumocfg"], {}, "missing.net.xml"),
        (["run.sumocfg"], {"counts": Path("counts.csv")}, "--counts: cannot be combined with SUMO's demand"),
        (["run.sumocfg"], {"surroundings_m": 200.0}, "--surroundings: cannot be combined"),
        (["cars.rou.xml"], {}, "no road map|expected"),
    ],
)
def test_rejects_demand_that_does_not_fit(
    files: Path, tmp_path: Path, given: list[str], options: dict[str, object], message: str
) -> None:
    (files / "missing.sumocfg").write_text(CONFIGURATION.format("missing.net.xml"))
    with pytest.raises(InputError, match=message):
        create_scenario(tmp_path / "made", [files / name for name in given], **options)
    assert not (tmp_path / "made").exists()
