"""Reading the results of a city run."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.city import city_run, results
from egvs.city.model import City
from egvs.core.errors import InputError

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
