"""A small run with houses, a lamp and a wide sensor, and scans of that sensor at other poses than planned."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

import egvs
from egvs.core.grid import FloatArray
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.formats import point_clouds
from egvs.sensors.sites import Pose
from tests.conftest import collection, feature, write_mini
from tests.extensions.hardware.installation.simulated_scan import simulate_scan

HOUSES = {
    "north": ([[8, 16], [30, 16], [30, 24], [8, 24], [8, 16]], 9),
    "south": ([[-4, -30], [22, -30], [22, -20], [-4, -20], [-4, -30]], 12),
    "east": ([[55, -8], [62, -8], [62, 9], [55, 9], [55, -8]], 7),
    "west": ([[-20, -3], [-12, -3], [-12, 14], [-20, 14], [-20, -3]], 10),
}
SENSOR = "[sensors.wide]\nchannels = 24\nelevations_deg = [-30, 16]\nazimuth_step_deg = 0.5\nrange_m = 100\n"
SITES = "site,x_m,y_m,z_m,yaw_deg,pitch_deg\npole_a,10,12,5,-60,-5\npole_b,30.5,-12,5,90,0\n"


@dataclass(frozen=True)
class InstalledRun:
    """A finished run, and simulated scans of the sensor at its site ``pole_a``."""

    folder: Path
    scans: Path

    @property
    def planned(self) -> Pose:
        return self.sites.site("pole_a").pose

    @property
    def sites(self) -> PlannedSites:
        return PlannedSites.open(self.folder)

    def points(self, boxes: Iterable[FloatArray] = (), seed: int = 0, **pose: float) -> FloatArray:
        """A scan at the planned pose with these differences, with noise and lost returns."""
        sites = self.sites
        site = sites.site("pole_a")
        actual = replace(site.pose, **{name: getattr(site.pose, name) + value for name, value in pose.items()})
        return simulate_scan(
            sites.session.scene, sites.sensor(site), site.pose, actual, boxes=boxes, sigma_m=0.02, lost=0.05, seed=seed
        )  # fmt: skip

    def write(self, name: str, points_m: FloatArray) -> Path:
        """Write a scan as a file."""
        path = self.scans / name
        point_clouds.write_points(path, points_m)
        return path


def write_installed_scenario(folder: Path) -> Path:
    """Write the scenario of :class:`InstalledRun`."""
    write_mini(folder)
    features = [
        feature({"type": "Polygon", "coordinates": [ring]}, name=name, kind="building", height_m=height)
        for name, (ring, height) in HOUSES.items()
    ]
    lamp = feature({"type": "Point", "coordinates": [22, -5]}, name="lamp", kind="pole", height_m=5, radius_m=0.1)
    (folder / "statics.geojson").write_text(collection(*features, lamp))
    scenario = (folder / "scenario.toml").read_text().replace('sensor = "small"', 'sensor = "wide"')
    scenario = scenario.replace("gamma = 4", 'gamma = 4\nrank_by = "expected_detections"')
    (folder / "scenario.toml").write_text(f"{scenario}\n{SENSOR}")
    (folder / "sites.csv").write_text(
        "site,x_m,y_m,z_m,yaw_deg,pitch_deg\npole_a,10,12,5,-60,-5\npole_b,30.5,-12,5,90,0\n"
    )
    return folder


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> InstalledRun:
    """The run; it is made once."""
    folder = tmp_path_factory.mktemp("installed")
    egvs.run(egvs.load(write_installed_scenario(folder / "crossing")), folder / "run", jobs=1)
    (folder / "scans").mkdir()
    return InstalledRun(folder / "run", folder / "scans")
