"""Columns of a sites file that are the user's own: which are carried through, as what, and which are misspelt."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest

import egvs
from egvs.artefacts.extra_columns import extra_columns
from egvs.core.errors import find_misspelling
from egvs.sensors import sites
from tests.conftest import collection, feature

CSV = """fid,site,x_m,y_m,z_m,owner,note,plan,cost,rank
1,pole_a,10,12,3,"City, east",,007,1200,b
2,pole_b,30.5,-12,3,Grid Ltd.,"by the ""old"" bridge",012,1300.5,
"""
OWN = {"fid": [1, 2], "owner": ["City, east", "Grid Ltd."], "note": [None, 'by the "old" bridge'],
       "plan": ["007", "012"], "cost": [1200.0, 1300.5], "given_rank": ["b", None]}  # fmt: skip
KNOWN = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor", "points")


@pytest.mark.slow
def test_columns_of_a_csv_arrive_in_the_scores_with_their_types(mini: Path, tmp_path: Path, run_egvs) -> None:
    plain = tmp_path / "plain"
    assert run_egvs("run", mini, "--out", plain)[0] == 0
    (mini / "sites.csv").write_text(CSV)
    code, _, said = run_egvs("run", mini, "--out", tmp_path / "own")
    assert code == 0, said
    scores = egvs.read_scores(tmp_path / "own" / "scores.parquet")
    assert {name: scores.column(name).to_pylist() for name in OWN} == OWN
    assert scores.schema.field("fid").type == pa.int64()
    assert scores.schema.field("cost").type == pa.float64()
    assert scores.drop_columns(list(OWN)).equals(egvs.read_scores(plain / "scores.parquet"))
    assert list(scores.to_pandas().owner) == OWN["owner"]
    assert run_egvs("verify", tmp_path / "own")[0] == 0


@pytest.mark.slow
def test_a_note_that_changes_is_in_the_next_scores(mini: Path, tmp_path: Path, run_egvs) -> None:
    for note in ("first", "second"):
        rows = f"site,x_m,y_m,z_m,note\npole_a,10,12,3,{note}\npole_b,30.5,-12,3,{note}\n"
        (mini / "sites.csv").write_text(rows)
        assert run_egvs("run", mini, "--out", tmp_path / "out")[0] == 0
        assert egvs.read_scores(tmp_path / "out" / "scores.parquet").column("note").to_pylist() == [note] * 2


def test_properties_of_geojson_keep_their_types(mini: Path) -> None:
    own = {
        "fid": 7,
        "lit": True,
        "tags": {"ref": ["A", 1]},
        "text": "12",
        "huge": 10**30,
        "none": None,
    }
    point = feature({"type": "Point", "coordinates": [0, 1, 2]}, name="a", **own)
    (mini / "sites.geojson").write_text(collection(point))
    (site,) = sites.candidate_sites(egvs.load(mini, ['sites.file="sites.geojson"']))
    expected = {"tags": '{"ref": ["A", 1]}', "huge": str(10**30)}
    assert site.user_columns == own | expected


def test_a_column_has_the_type_that_all_its_values_have() -> None:
    rows = [{"a": 1, "b": 1, "c": 1, "d": True, "e": None}, {"a": None, "b": 0.5, "c": "x", "d": False}, {"f": "y"}]
    columns = extra_columns(rows, ("a", "given_a", "f"))
    assert {name: (column.to_pylist(), str(column.type)) for name, column in columns.items()} == {
        "given_given_a": ([1, None, None], "int64"),
        "b": ([1.0, 0.5, None], "double"),
        "c": (["1", "x", None], "string"),
        "d": ([True, False, None], "bool"),
        "e": ([None] * 3, "string"),
        "given_f": ([None, None, "y"], "string"),
    }


@pytest.mark.parametrize(
    ("name", "meant"),
    [("yaw", "yaw_deg"), ("YAW_DEG", "yaw_deg"), ("pitch_dg", "pitch_deg"), ("role_deg", "roll_deg"),
     ("sensors", "sensor"), ("point", "points"), ("x", "x_m"), ("Z_M", "z_m")],
)  # fmt: skip
def test_a_near_miss_of_a_known_name_is_found_where_that_is_missing(name: str, meant: str) -> None:
    assert find_misspelling([name, *(set(KNOWN) - {meant})], KNOWN) == (name, meant)
    assert find_misspelling([name, *KNOWN], KNOWN) is None


def test_names_of_ones_own_are_left_alone() -> None:
    assert (
        find_misspelling(
            ["fid", "owner", "note", "name", "side", "height", "street", "id", "tilt", "lamp", "type"], KNOWN
        )
        is None
    )


def test_a_misspelt_column_is_told_once_for_all_rows(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,yaw\na,10,12,3,90\nb,30.5,-12,3,90\nc,20,12,3,0\n")
    code, _, said = run_egvs("run", mini, "--out", tmp_path)
    assert code == 2
    assert said.count("unknown column 'yaw'. Did you mean yaw_deg?") == 1
    assert "row a and 2 more: " in said


@pytest.mark.parametrize(("name", "meant"), [("heigth_m", "height_m"), ("height", "height_m"), ("bse_m", "base_m")])
def test_a_misspelt_height_of_a_footprint_is_told(mini: Path, tmp_path: Path, run_egvs, name: str, meant: str) -> None:
    heights = {"height_m": 6, "base_m": 3, "building:levels": 2, "owner": "x"}
    house = {"type": "Polygon", "coordinates": [[[14, 5], [18, 5], [18, 8], [14, 5]]]}
    for spelt in (False, True):
        own = {name if spelt and key == meant else key: value for key, value in heights.items()}
        (mini / "statics.geojson").write_text(collection(feature(house, **own)))
        code, _, said = run_egvs("run", mini, "--out", tmp_path)
        assert code == (2 if spelt else 0), said
    assert f"unknown property '{name}'; did you mean {meant}?" in said
