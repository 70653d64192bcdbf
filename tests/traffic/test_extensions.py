"""Whatever keeps to the protocol of extensions takes part in the traffic, known to nobody by name."""

from dataclasses import replace

import pytest

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.runtime import no_progress
from egvs.effects.base import Traffic
from egvs.scenario.effects_config import EffectParameters
from egvs.stages import traffic
from egvs.traffic import recording, trajectories
from egvs.traffic.vehicle_boxes import ExtraTraffic, VehicleSize
from egvs.world import geolocation
from tests.stages import run_stage
from tests.traffic.helpers import SMALL, scenario

TRAM = VehicleSize(30.0, 2.4, 3.5, "tram")


class Raised:
    """Lifts every box, and says how many there were."""

    def __init__(self, sizes):
        self.sizes, self.boxes = sizes, 0

    def change(self, boxes):
        self.boxes += boxes.frame.size
        return replace(boxes, z_m=boxes.z_m + 100.0)

    def summary(self):
        return {"raised": self.boxes, "kinds": sorted(self.sizes)}


class Guests(Traffic):
    """One more vehicle, which does not count, and boxes that are lifted."""

    NAME = "guests"
    ADDS_TRAFFIC = True

    def sizes(self):
        return {"guest": TRAM}

    def uncounted_types(self, sizes):
        return frozenset({"guest"})

    def plan(self, scenario, roads, begin_s, end_s, rng):
        lane = next(edge for edge in roads.edges if edge.lanes_for("passenger"))
        vtype = '<vType id="guest" vClass="passenger" length="30" width="2.4" height="3.5"/>'
        stop = f'<stop edge="{lane.id}" duration="9999" parking="true"/>'
        guest = f'<trip id="guest" type="guest" depart="0" from="{lane.id}" to="{lane.id}">{stop}</trip>'
        return ExtraTraffic(f"<routes>{vtype}{guest}</routes>", 1, (f"a guest from {begin_s:g} to {end_s:g} s",))

    def box_change(self, scenario, sizes):
        return Raised(sizes)


def recorded(scene, out, *acting):
    with (
        recording.record_traffic(
            scene, out / "sumo", acting, no_progress, None, geolocation.scenario_georeference(scene)
        ) as rows,
        parquet.artefact_writer(out / "trajectories.parquet", "trajectories") as file,
    ):
        tally, reports = trajectories.write_trajectories(scene, rows, acting, file, no_progress)
        file.describe({"schema": 1, "frames": 1})
        return tally.to_json(rows.window.period_ms / 1000.0), reports, rows.summary()


@pytest.mark.slow
def test_an_extension_adds_traffic_that_does_not_count_and_changes_boxes(town, tmp_path):
    scene = scenario(town, network="net.xml", **SMALL)
    counts, reports, summary = recorded(scene, tmp_path, Guests(EffectParameters()))
    plain = run_stage(traffic, scene, tmp_path / "plain")
    assert (counts["vehicles"]["fewest"], counts["vehicles"]["most"]) == (12, 12)
    beside = counts["beside_vehicles"]
    assert set(beside) == {"tram", "overlapping_pairs"} and beside["tram"]["most"] == 1
    assert reports["kinds"] == sorted({"car", "van", "truck", "bus"})
    assert reports["raised"] == plain["rows"] + beside["tram"]["mean"] * 240
    assert summary.notes == ["a guest from 0 to 120 s"]
    flags = " ".join(summary.flags)
    assert "trips.rou.xml,others.rou.xml" in flags and "--max-num-vehicles 13" in flags


def test_two_extensions_have_a_route_file_each_and_change_boxes_one_after_another(town, tmp_path):
    class Others(Guests):
        def plan(self, *arguments):
            return ExtraTraffic("<routes/>", 0)

    scene = scenario(town, network="net.xml", **SMALL)
    counts, _, summary = recorded(scene, tmp_path, Guests(EffectParameters()), Others(EffectParameters()))
    flags = " ".join(summary.flags)
    assert "trips.rou.xml,others.rou.xml,others1.rou.xml" in flags and "--max-num-vehicles 13" in flags
    assert counts["vehicles"]["most"] == 12
    lifted = parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")[0]["z_m"].to_numpy()
    assert lifted.min() > 200 and lifted.max() < 202


def test_what_an_extension_refuses_is_raised_before_anything_is_laid_out(town, tmp_path):
    class Choosy(Guests):
        def scenario_error(self, scenario):
            return InputError("guests", "this is no place for guests", "Use another place.")

    with pytest.raises(InputError, match="no place for guests"):
        recorded(scenario(town, network="net.xml", **SMALL), tmp_path, Choosy(EffectParameters()))
    assert not (tmp_path / "sumo").exists()
