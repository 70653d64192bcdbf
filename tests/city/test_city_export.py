"""Exporting a city run: junctions, the plan and all sites as layers."""

from __future__ import annotations

import csv
from pathlib import Path

import pyogrio
import pytest

from egvs.city import city_run
from egvs.city.city_run import CityRunOptions
from egvs.city.model import City
from egvs.core.errors import InputError
from egvs.export.export import export_run

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("in_process_cluster")]


@pytest.mark.slow
def test_exports_city_run(city: City, tmp_path: Path) -> None:
    placed = city_run.place_city(city, tmp_path / "out", count=2)
    (path,) = export_run(tmp_path / "out", "gpkg").paths
    assert path.name == "town.gpkg"
    layers = {name: pyogrio.read_dataframe(path, layer=name) for name in ("junctions", "plan", "sites")}
    assert layers["junctions"]["junction"].tolist() == ["west", "east"]
    assert layers["junctions"].geometry.x.tolist() == [20.0, 520.0]
    assert layers["plan"]["site"].tolist() == [sensor.site for sensor in placed.plan.sensors]
    assert len(layers["sites"]) == 4
    written = export_run(tmp_path / "out", "csv").paths
    assert [path.stem for path in written] == ["junctions", "plan", "sites"]
    with written[0].open(encoding="utf-8-sig") as file:
        assert [row["rank"] for row in csv.DictReader(file)] == ["1", "2"]


@pytest.mark.slow
def test_leaves_out_old_plan_and_rejects_geotiff(city: City, tmp_path: Path) -> None:
    out = city_run.run_city(city, tmp_path / "out").out
    with pytest.raises(InputError, match=r"--to geotiff: .* is the folder of a city. Export a junction"):
        export_run(out, "geotiff")
    city_run.place_city(city, out, count=1)
    ran = city_run.run_city(city, out, CityRunOptions(overrides=["roi.voxel_m=1"]))
    assert "plan.parquet" not in {path.name for path in ran.files}
    done = export_run(out, "geojson")
    assert [path.stem for path in done.paths] == ["junctions", "sites"]
    assert done.notes == ("the plan is left out: it is for other junctions or settings. Run egvs city place again",)
    (out / "junctions" / "west" / "scores.parquet").unlink()
    with pytest.raises(InputError, match=r"scores\.parquet"):
        export_run(out, "geojson")
