"""Exporting a city run: junctions, the plan and all sites as layers."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pyogrio
import pytest

import egvs
from egvs.core.errors import InputError, MissingExtraError
from egvs.export.export import export_run
from egvs.extensions.city import city_run
from egvs.extensions.city.city_run import CityRunOptions
from egvs.extensions.city.model import City

pytestmark = [pytest.mark.system, pytest.mark.usefixtures("in_process_cluster")]


@pytest.mark.slow
def test_exports_city_run(city: City, tmp_path: Path) -> None:
    placed = city_run.place_city(city, tmp_path / "out", count=2, phases=[1])
    (path,) = export_run(tmp_path / "out", "gpkg").paths
    assert path.name == "town.gpkg"
    layers = {name: pyogrio.read_dataframe(path, layer=name) for name in ("junctions", "plan", "sites", "region")}
    assert layers["junctions"]["junction"].tolist() == ["west", "east"]
    assert layers["junctions"].geometry.x.tolist() == [20.0, 520.0]
    assert layers["plan"]["site"].tolist() == [sensor.site for sensor in placed.plan.sensors]
    assert layers["plan"]["phase"].tolist() == [1, 2]
    assert len(layers["sites"]) == 4
    regions = layers["region"]
    assert regions["junction"].tolist() == ["east", "west"]
    for region, junction in zip(regions.geometry, ("east", "west"), strict=True):
        roi = egvs.load(city.folder / "junctions" / junction).roi.box
        (x, y, _), (width, depth, _) = roi.origin_m, roi.size_m
        assert region.bounds == (x, y, x + width, y + depth)
        at = layers["junctions"].set_index("junction").geometry[junction]
        assert region.contains(at)
    written = export_run(tmp_path / "out", "csv").paths
    assert [path.stem for path in written] == ["junctions", "plan", "sites", "region"]
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
    assert [path.stem for path in done.paths] == ["junctions", "sites", "region"]
    assert done.notes == ("the plan is left out: it is for other junctions or settings. Run egvs city place again",)
    (out / "junctions" / "west" / "scores.parquet").unlink()
    with pytest.raises(InputError, match=r"scores\.parquet"):
        export_run(out, "geojson")


@pytest.mark.slow
def test_names_missing_extra_in_one_message(city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = city_run.run_city(city, tmp_path / "out").out
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    with pytest.raises(MissingExtraError, match=r"export to gpkg.*pip install .*egvs\[gis\]"):
        export_run(out, "gpkg")
    assert not (out / "export").exists()
