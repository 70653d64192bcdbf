"""A served folder with a scenario that needs no simulation, and one with a junction made from a map."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomlkit

from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
from tests.conftest import write_mini
from tests.extensions.desk.serving import Client, serving

MAP = Path(__file__).parents[2] / "creation" / "data" / "small.osm"
"""A made-up town with a signal mast, two lamps and a junction with signals."""


@pytest.fixture(scope="session")
def made_town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario from the map, with existing poles."""
    folder = tmp_path_factory.mktemp("made") / "town"
    create_scenario(folder, MAP, options=NewScenarioOptions(existing_poles=True))
    return folder


def write_periods(town: Path) -> None:
    """Give the town a morning, with its counts, and an evening with others."""
    toml, counts = town / "scenario.toml", (town / "counts.csv").read_text()
    (town / "evening.csv").write_text(counts.replace(",65\n", ",40\n"))
    table = '\n[[traffic.periods]]\nname = "{}"\ncounts = "{}"\n'
    toml.write_text(toml.read_text() + table.format("morning", "counts.csv") + table.format("evening", "evening.csv"))


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Client]:
    """A page over a folder with the scenario ``mini``."""
    folder = tmp_path / "work"
    folder.mkdir()
    write_mini(folder / "mini")
    with serving(folder, tmp_path / "scratch") as client:
        yield client


def write_inline_plan(town: Path) -> None:
    """Write the plan of the town's signal into scenario.toml, in place of its table."""
    toml = tomlkit.parse((town / "scenario.toml").read_text())
    (plan,) = toml["traffic"]["signals"].values()
    with (town / plan.pop("file")).open() as rows:
        table = list(csv.DictReader(rows))
    plan["phases"] = [
        {
            "green_s": float(next(row["green_s"] for row in table if row["phase"] == number)),
            "green": {row["approach"]: row["movement"].split() for row in table if row["phase"] == number},
        }
        for number in dict.fromkeys(row["phase"] for row in table)
    ]
    (town / "scenario.toml").write_text(tomlkit.dumps(toml))


@pytest.fixture
def town(desk: Client, made_town: Path, tmp_path: Path) -> Client:
    """The page with the town open."""
    shutil.copytree(made_town, tmp_path / "work" / "town")
    desk.ok("POST", "/api/open", {"scenario": "town"})
    return desk
