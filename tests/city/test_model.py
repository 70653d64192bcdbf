"""A city's folder is read, and what is wrong in it is told in one message."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from egvs.artefacts import parquet
from egvs.city import model
from egvs.core.errors import InputError

ROW = "j1,junction of A and B,10.5,-3,50.1,9.2,true"
HEAD = "junction,title,x_m,y_m,lat_deg,lon_deg,signalised"


def write_city(folder: Path, *rows: str, toml: str = 'seed = 3\n[traffic]\nnetwork = "network.net.xml"\n') -> Path:
    """A city's folder with these rows; each junction has an empty scenario."""
    folder.mkdir(exist_ok=True)
    (folder / "city.toml").write_text(toml, encoding="utf-8")
    (folder / "junctions.csv").write_text("\n".join([HEAD, *rows, ""]), encoding="utf-8")
    for row in rows:
        if "/" not in (name := row.split(",")[0]):
            (folder / "junctions" / name).mkdir(parents=True, exist_ok=True)
            (folder / "junctions" / name / "scenario.toml").touch()
    return folder


def test_a_city_is_read_by_its_folder_or_its_file(tmp_path: Path) -> None:
    folder = write_city(tmp_path / "town", ROW, 'j2,"B, C",0,0,-1,180,FALSE')
    for path in (folder, folder / "city.toml"):
        city = model.load_city(path)
        assert (city.name, city.seed, city.folder, city.traffic.frames) == ("town", 3, folder, 5000)
        assert [j.id for j in city.junctions] == ["j1", "j2"]
        assert city.junctions[0] == model.CityJunction("j1", "junction of A and B", 10.5, -3.0, 50.1, 9.2, True)
        assert city.junction("j2").title == "B, C" and not city.junction("j2").signalised
        assert city.junctions[0].scenario_folder(city) == folder / "junctions" / "j1"
        assert city.junctions[0].traffic_file(city) == folder / "traffic" / "j1.parquet"


def test_a_table_that_is_written_is_read_again(tmp_path: Path) -> None:
    junctions = model.load_city(write_city(tmp_path, ROW, 'j2,"B, ""C""",0.1,0,-1,180,false')).junctions
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(model.table_rows(junctions))
    (tmp_path / "junctions.csv").write_text(text.getvalue(), encoding="utf-8")
    assert model.load_city(tmp_path).junctions == junctions


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([], "junctions.csv: holds no junction; at least one"),
        ([ROW, ROW.replace("j1", "J1")], "junction J1: stands there twice"),
        ([ROW.replace("j1", "a/b")], "junction a/b: junction: 'a/b'. Use a name"),
        ([ROW.replace("10.5", "nan")], "junction j1: x_m: 'nan'; a number from -1e+08 to 1e+08"),
        ([ROW.replace("50.1", "91")], "junction j1: lat_deg: '91'; a number from -90 to 90"),
        ([ROW.replace("9.2", "east")], "junction j1: lon_deg: 'east'; a number from -180 to 180"),
        ([ROW.replace("true", "yes")], "junction j1: signalised: 'yes'; true or false"),
        ([ROW + ",more"], "junction j1: has more or fewer values"),
        (["j1,A"], "junction j1: has more or fewer values"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, rows: list[str], told: str) -> None:
    with pytest.raises(InputError) as caught:
        model.load_city(write_city(tmp_path, *rows))
    assert told in str(caught.value)


@pytest.mark.parametrize(
    ("toml", "told"),
    [
        (
            "seed = -1\n[traffic]\nnetwork = 'n'\n",
            "city.toml: seed: expected a value greater than or equal to 0, got -1",
        ),
        ("sed = 1\n[traffic]\nnetwork = 'n'\n", "city.toml: sed: unknown key. Did you mean seed?"),
        ("seed = 1\n", "city.toml: traffic: this key is required"),
        ("[traffic]\nfcd = 'a'\nnetwork = 'n'\n", "exactly one of network, sumocfg and fcd"),
        ("[traffic]\nfcd = 'a'\nvehicles = 3\n", "city.toml: traffic: vehicles has no effect with fcd"),
        ("[traffic\n", "city.toml: is not valid TOML"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, toml: str, told: str) -> None:
    with pytest.raises(InputError) as caught:
        model.load_city(write_city(tmp_path, ROW, toml=toml))
    assert told in str(caught.value)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no city\.toml there; a folder that egvs city new made"):
        model.load_city(tmp_path)
    folder = write_city(tmp_path / "town", ROW)
    (folder / "junctions" / "j1" / "scenario.toml").unlink()
    with pytest.raises(InputError, match=r"scenario\.toml: no such file; a scenario there, or no row j1 in"):
        model.load_city(folder)
    with pytest.raises(InputError, match=r"--junction j9: no such junction .*; one of j1"):
        model.load_city(write_city(tmp_path / "town", ROW)).junction("j9")
    (folder / "junctions.csv").write_text("junction;title\n", encoding="utf-8")
    with pytest.raises(InputError, match="has the columns junction;title; the columns junction, title, x_m"):
        model.load_city(folder)
    (folder / "junctions.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"junctions\.csv: cannot be read as CSV"):
        model.load_city(folder)
    (folder / "junctions.csv").unlink()
    with pytest.raises(InputError, match=r"junctions\.csv: no such file; a table with the columns"):
        model.load_city(folder)


def test_editor_schema_is_not_stale() -> None:
    kept = parquet.schema_folder() / "city_file.schema.json"
    assert kept.read_text(encoding="utf-8") == model.city_json_schema(), "run: make schema"
