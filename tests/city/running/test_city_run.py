"""A whole city run, from the city's traffic to its page: the same as its junctions alone, brought together."""

from __future__ import annotations

import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.city import city_run, model, results, traffic_split
from egvs.city.model import City
from egvs.core.errors import InputError
from egvs.runs import run


def files_of(out: Path) -> dict[str, bytes]:
    """All that a city run leaves and that has no cost in it."""
    left = ("report.html", "run.json", ".lock")
    return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file() and p.name not in left}


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_a_city_run_is_its_junctions_alone(city: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = city_run.run_city(city, tmp_path / "out")
    assert [its.junction.id for its in ran.results] == ["west", "east"]
    for junction in city.junctions:
        with monkeypatch.context() as patch:
            patch.setenv("EGVS_STORE", str(tmp_path / "store of its own"))
            run.run(egvs.load(junction.scenario_folder(city)), tmp_path / "alone" / junction.id)
        for path in (tmp_path / "alone" / junction.id).glob("*.p*"):
            assert path.read_bytes() == (results.junction_run_folder(ran.out, junction.id) / path.name).read_bytes()
    first = files_of(ran.out)
    monkeypatch.setenv("EGVS_STORE", str(tmp_path / "another store"))
    again = city_run.run_city(city, tmp_path / "again")
    assert files_of(again.out) == first


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_scores_are_one_table_and_junctions_are_ranked(city: City, tmp_path: Path) -> None:
    sites = city.folder / "junctions" / "east" / "sites.csv"
    head, *rows = sites.read_text().splitlines()
    sites.write_text("\n".join([f"{head},owner", *(f"{row},city" for row in rows), ""]))  # a column of one junction
    ran = city_run.run_city(model.load_city(city.folder), tmp_path / "out")
    scores = results.read_city_scores(ran.out)
    assert scores.column("junction").to_pylist() == ["east", "east", "west", "west"]
    assert scores.column("owner").to_pylist() == ["city", "city", None, None]
    assert pq.read_table(ran.out / "scores" / "junction=west").num_rows == 2
    table, about = parquet.read_artefact(ran.out / "junctions.parquet", "city")
    assert about["rank_by"] == "egvs"
    best = {name: max(s["egvs"] for s in scores.to_pylist() if s["junction"] == name) for name in ("east", "west")}
    for row in table.to_pylist():
        assert row["egvs"] == row["score"] == best[row["junction"]]
    assert table.column("rank").to_pylist() == [1, 2]
    html = (ran.out / "city.html").read_text()
    assert re.findall(r'href="(junctions/\w+/report\.html)"', html)[-2:] == [
        "junctions/west/report.html", "junctions/east/report.html",
    ]  # fmt: skip
    assert all((ran.out / link).is_file() for link in re.findall(r'href="(junctions/[^"]+)"', html))
    assert "http" not in re.sub(r"arXiv|http://www.w3.org/2000/svg", "", html)


def test_the_traffic_of_one_junction_is_no_ones(city: City, tmp_path: Path) -> None:
    for override in ("traffic.frames=5", "traffic.periods.rush.weight=2", "traffic = {}"):
        with pytest.raises(InputError) as caught:
            city_run.run_city(city, tmp_path / "out", sets=["score.gamma=2", override])
        assert str(caught.value).startswith(f"--set {override}: the traffic of a city is simulated once")
        assert f" in {city.file}, then " in str(caught.value)


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_one_junction_alone_is_chosen(city: City, tmp_path: Path) -> None:
    city_run.run_city(city, tmp_path / "out")
    ran = city_run.run_city(city, tmp_path / "out", only=["east"], sets=["score.gamma=2"])
    assert [its.junction.id for its in ran.results] == ["east"]
    assert [path.name for path in (ran.out / "scores").iterdir()] == ["junction=east"]
    assert egvs.load(city.folder / "junctions" / "east").score.gamma == 4  # laid over, not written
    assert '"gamma": 2' in (results.junction_run_folder(ran.out, "east") / "run.json").read_text()
    with pytest.raises(InputError, match=r"--junction north: no such junction in .*; one of west, east"):
        city_run.run_city(city, tmp_path / "out", only=["north"])


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_junctions_that_rank_by_different_scores_are_refused(city: City, tmp_path: Path) -> None:
    path = city.folder / "junctions" / "east" / "scenario.toml"
    path.write_text(path.read_text().replace("[score]", '[score]\nrank_by = "coverage"'))
    with pytest.raises(InputError, match=r"score.rank_by: coverage, and egvs at west"):
        city_run.run_city(city, tmp_path / "out")


def test_a_wrong_word_for_the_cluster_stops_before_the_traffic(city: City, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--cluster: 'nowhere'"):
        city_run.run_city(city, tmp_path / "out", where="nowhere")
    assert not (city.folder / "traffic" / traffic_split.SEAL_FILE).exists()


def test_a_folder_without_scores_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scores there; the folder of a finished egvs city run"):
        results.read_city_scores(tmp_path)
