"""Reading the results of a city run."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.extensions.city import city_run, results
from egvs.extensions.city.model import City

pytestmark = pytest.mark.system


@pytest.mark.slow
@pytest.mark.usefixtures("in_process_cluster")
def test_rejects_different_scores(city: City, tmp_path: Path) -> None:
    path = city.folder / "junctions" / "east" / "scenario.toml"
    path.write_text(path.read_text().replace("[score]", '[score]\nrank_by = "coverage"'))
    with pytest.raises(InputError, match=r"score.rank_by: expected egvs, as for junction west, got coverage"):
        city_run.run_city(city, tmp_path / "out")


def test_rejects_folder_without_scores(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there are no scores in this folder. .* a finished egvs city run"):
        results.read_city_scores(tmp_path)


def write_scores(out: Path, junction: str, users: dict[str, pa.Array] | None = None) -> None:
    """Write the scores of a junction with one site."""
    schema = parquet.arrow_schema("scores")
    values = {pa.string(): "a", pa.float64(): 1.0, pa.uint32(): 1}
    columns = {field.name: pa.array([values[field.type]]) for field in schema}
    path = results.junction_run_folder(out, junction) / "scores.parquet"
    with parquet.artefact_writer(path, "scores", (), users) as file:
        file.write(columns | (users or {}))
        file.describe({"schema": 1, "rank_by": "egvs", "sites": []})


def test_dataset_of_scores_tells_numeric_names_apart(tmp_path: Path) -> None:
    names = ["007", "7", "_7"]
    for name in names:
        write_scores(tmp_path, name)
    (tmp_path / "scores" / "junction=007").mkdir(parents=True)  # of an earlier version
    results._write_scores(tmp_path, [*names[1:], names[0]])
    assert sorted(ds.dataset(tmp_path / "scores", partitioning="hive").to_table()["junction"].to_pylist()) == names
    assert sorted(pq.read_table(tmp_path / "scores")["junction"].to_pylist()) == names
    assert sorted(results.read_city_scores(tmp_path)["junction"].to_pylist()) == names


def test_column_of_the_user_is_not_the_junction(tmp_path: Path) -> None:
    write_scores(tmp_path, "west", {"junction": pa.array(["A 4"])})
    results._write_scores(tmp_path, ["west"])
    table = results.read_city_scores(tmp_path)
    assert (table["junction"].to_pylist(), table["given_junction"].to_pylist()) == (["west"], ["A 4"])
