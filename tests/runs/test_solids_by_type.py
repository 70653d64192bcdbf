"""Do footprints by hand and a SUMO .poly.xml of the same buildings end in the same scores, whatever else lies there?"""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.conftest import BUILDING, collection, feature

RING = " ".join(f"{x},{y}" for x, y in BUILDING[0])
WHOLE_ROI = "0,-10 40,-10 40,10 0,10"
HOUSE = f'<poly id="h" type="building" fill="1" shape="{RING}"'
GROUNDS = "".join(
    f'<poly id="g{number}" type="{kind}" fill="1" layer="-3" shape="{WHOLE_ROI}"/>'
    for number, kind in enumerate(("landuse", "residential", "parking", "amenity.parking", "park", "water"))
)


def scores(folder: Path) -> list[tuple[float, int]]:
    table = pq.read_table(folder / "scores.parquet")
    return list(zip(table["egvs"].to_pylist(), table["rank"].to_pylist(), strict=True))


@pytest.mark.slow
def test_poly_xml_gives_ranking_of_footprints(mini: Path, tmp_path: Path, run_egvs) -> None:
    house = feature({"type": "Polygon", "coordinates": BUILDING}, height_m=6)
    (mini / "statics.geojson").write_text(collection(house), encoding="utf-8")
    (mini / "map.poly.xml").write_text(f'<additional>{HOUSE} height="6.00"/>{GROUNDS}</additional>', encoding="utf-8")
    (mini / "odd.poly.xml").write_text(
        f'<additional>{HOUSE} height="6.00"/><poly id="o" type="sculpture" fill="1" shape="{WHOLE_ROI}"/></additional>',
        encoding="utf-8",
    )
    found = {}
    for name, settings in {
        "hand": [],
        "bare": ["statics.footprints=[]"],
        "map": ["statics.footprints=[]", 'statics.polygons=["map.poly.xml"]'],
        "odd": ["statics.footprints=[]", 'statics.polygons=["odd.poly.xml"]'],
    }.items():
        options = [part for setting in settings for part in ("--set", setting)]
        code, out, err = run_egvs("run", mini, "--out", tmp_path / name, *options)
        assert code == 0, err
        found[name] = scores(tmp_path / name)
        if name == "odd":
            assert "polygons of unknown types were left out: sculpture (1)" in out + err
    assert found["map"] == found["hand"] == found["odd"]
    assert found["bare"] != found["hand"], "the building is not in the way of any site"
    record = json.loads((tmp_path / "odd" / "run.json").read_text(encoding="utf-8"))
    assert [w["rule"] for w in record["stages"]["statics"]["summary"]["warnings"]] == ["polygon types"]
    assert "unknown types of polygons were left out" in (tmp_path / "odd" / "report.html").read_text(encoding="utf-8")
