"""Reading the folder of a city, and messages about wrong input."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.extensions.city import model

ROW = "j1,junction of A and B,10.5,-3,50.1,9.2,true"
HEAD = "junction,title,x_m,y_m,lat_deg,lon_deg,signalised"


def write_city(folder: Path, *rows: str, toml: str = 'seed = 3\n[traffic]\nnetwork = "network.net.xml"\n') -> Path:
    """Write the folder of a city with these rows; each junction has an empty scenario."""
    folder.mkdir(exist_ok=True)
    (folder / "city.toml").write_text(toml, encoding="utf-8")
    (folder / "junctions.csv").write_text("\n".join([HEAD, *rows, ""]), encoding="utf-8")
    for row in rows:
        name = row.split(",")[0]
        if "/" not in name:
            (folder / "junctions" / name).mkdir(parents=True, exist_ok=True)
            (folder / "junctions" / name / "scenario.toml").touch()
    return folder


def test_loads_city_by_folder_or_file(tmp_path: Path) -> None:
    folder = write_city(tmp_path / "town", ROW, 'j2,"B, C",0,0,-1,180,FALSE')
    for path in (folder, folder / "city.toml"):
        city = model.load_city(path)
        assert (city.name, city.seed, city.folder, city.traffic.frames) == ("town", 3, folder, 5000)
        assert [j.id for j in city.junctions] == ["j1", "j2"]
        assert city.junctions[0] == model.CityJunction("j1", "junction of A and B", 10.5, -3.0, 50.1, 9.2, True)
        assert city.junction("j2").title == "B, C" and not city.junction("j2").signalised
        assert city.junctions[0].scenario_folder(city) == folder / "junctions" / "j1"
        assert city.junctions[0].traffic_file(city) == folder / "traffic" / "j1.parquet"


def test_reads_table_as_written(tmp_path: Path) -> None:
    junctions = model.load_city(write_city(tmp_path, ROW, 'j2,"B, ""C""",0.1,0,-1,180,false')).junctions
    (tmp_path / "junctions.csv").write_text(model.junctions_csv(junctions), encoding="utf-8")
    assert model.load_city(tmp_path).junctions == junctions


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "junctions.csv: the table has no junctions. Add at least one row"),
        ([ROW, ROW.replace("j1", "J1")], "line 3 (J1): this name occurs twice"),
        ([ROW.replace("j1", "caf\u00e9"), ROW.replace("j1", "cafe\u0301")], "this name occurs twice"),
        ([ROW.replace("j1", '"a\nb"')], r"junction: invalid name 'a\nb'"),
        ([ROW.replace("10.5", "1_0")], "line 2 (j1): x_m: expected a number from -1e+08 to 1e+08, got '1_0'"),
        ([ROW.replace("50.1", "\u0665\u0660")], "lat_deg: expected a number from -90 to 90, got '\u0665\u0660'"),
        ([ROW.replace("j1", "a/b")], "line 2 (a/b): junction: invalid name 'a/b'"),
        ([ROW.replace("10.5", "nan")], "line 2 (j1): x_m: expected a number from -1e+08 to 1e+08, got 'nan'"),
        ([ROW.replace("50.1", "91")], "line 2 (j1): lat_deg: expected a number from -90 to 90, got '91'"),
        ([ROW.replace("9.2", "east")], "line 2 (j1): lon_deg: expected a number from -180 to 180, got 'east'"),
        ([ROW.replace("true", "yes")], "line 2 (j1): signalised: expected true or false, got 'yes'"),
        ([ROW + ",more"], "line 2: expected 7 values, got"),
        (["j1,A"], "line 2: expected 7 values, got"),
    ],
)
def test_rejects_wrong_row(tmp_path: Path, rows: list[str], message: str) -> None:
    with pytest.raises(InputError) as caught:
        model.load_city(write_city(tmp_path, *rows))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (
            "seed = -1\n[traffic]\nnetwork = 'n'\n",
            "city.toml: seed: expected a value greater than or equal to 0, got -1",
        ),
        ("sed = 1\n[traffic]\nnetwork = 'n'\n", "city.toml: sed: unknown key. Did you mean seed?"),
        ("seed = 1\n", "city.toml: traffic: this key is required"),
        ("[traffic]\nfcd = 'a'\nnetwork = 'n'\n", "exactly one of network, sumocfg, fcd and tracks"),
        ("[traffic]\nfcd = 'a'\nvehicles = 3\n", "city.toml: traffic: vehicles has no effect with fcd"),
        ("[traffic\n", "city.toml: is not valid TOML"),
    ],
)
def test_rejects_wrong_key(tmp_path: Path, toml: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        model.load_city(write_city(tmp_path, ROW, toml=toml))
    assert message in str(caught.value)


def test_rejects_missing_or_damaged_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no city\.toml in this folder. .* created by egvs city new"):
        model.load_city(tmp_path)
    folder = write_city(tmp_path / "town", ROW)
    (folder / "junctions" / "j1" / "scenario.toml").unlink()
    with pytest.raises(InputError, match=r"scenario\.toml: no such file. .* remove the row j1 from"):
        model.load_city(folder)
    with pytest.raises(InputError, match=r"--junction j9: no such junction .* Use one of j1"):
        model.load_city(write_city(tmp_path / "town", ROW)).junction("j9")
    (folder / "junctions.csv").write_text("junction;title\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"the columns are junction, title. Use the columns junction, title, x_m"):
        model.load_city(folder)
    (folder / "junctions.csv").write_bytes(b"\xff\xfea")
    with pytest.raises(InputError, match=r"junctions\.csv: is no text in a known encoding"):
        model.load_city(folder)
    (folder / "junctions.csv").unlink()
    with pytest.raises(InputError, match=r"junctions\.csv: no such file. Give a table .* Use the columns"):
        model.load_city(folder)


@pytest.mark.parametrize("link", ["traffic", "traffic/periods", "traffic/periods/rush"])
def test_rejects_traffic_folder_outside_the_city(tmp_path: Path, link: str) -> None:
    folder = write_city(tmp_path / "town", ROW)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (folder / link).parent.mkdir(parents=True, exist_ok=True)
    (folder / link).symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(InputError) as caught:
        model.load_city(folder)
    assert f"{folder / link}: expected a folder, got a link to {elsewhere}. Remove the link" in str(caught.value)


def test_editor_schema_is_up_to_date() -> None:
    schema_file = parquet.schema_folder() / "city_file.schema.json"
    assert schema_file.read_text(encoding="utf-8") == model.city_json_schema(), "run: make schema"
