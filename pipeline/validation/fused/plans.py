"""Reads a plan of several sensors, which ``egvs place`` wrote, to look from its poses."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import checksums, tables
from pipeline.artefacts.readers import PLACEMENT_SUMS
from pipeline.core.errors import InputError
from pipeline.placement.writing import PLACEMENT
from pipeline.scenario.models import Scenario
from pipeline.sensing import sensors
from pipeline.sensing.sites import Pose, Site
from pipeline.sensing.sites import of as candidates_of
from pipeline.validation.clouds import point_clouds


@dataclass(frozen=True)
class Group:
    """Sensors that look together."""

    sites: tuple[Site, ...]

    @property
    def name(self) -> str:
        """That of all its sites."""
        return " + ".join(site.name for site in self.sites)


@dataclass(frozen=True)
class Plan:
    """A plan.

    Attributes
    ----------
    path
        Where it was read.
    sites
        Its sensors, in the order of the plan.
    score
        What they were chosen by.
    inputs
        Hash of all that it was made from.
    statics
        Key of the static world that it was made in; empty where it does not say.
    """

    path: Path
    sites: tuple[Site, ...]
    score: str
    inputs: str
    statics: str

    @property
    def groups(self) -> tuple[Group, ...]:
        """The first sensor, the first two, and so on."""
        return tuple(Group(self.sites[: number + 1]) for number in range(len(self.sites)))


def read(folder: Path, scenario: Scenario) -> Plan:
    """The plan in a run's folder.

    Raises
    ------
    InputError
        Where there is none, it was altered, it is of another scenario, or has a sensor that is unknown or a site whose
        scan was measured, which cannot look at traffic.
    """
    path = folder / PLACEMENT
    if not path.is_file():
        right = f"egvs place {scenario.name} --count 3 makes one; --plan-from names the folder of another"
        raise InputError(path, "no such file: no plan was made there", right)
    checksums.check(path.with_name(PLACEMENT_SUMS), "run egvs place again")
    table, about = tables.read(path, "placement")
    of = about.get("scenario")
    if not isinstance(of, dict) or of.get("name") != scenario.name:
        found = f"a plan for {of.get('name') if isinstance(of, dict) else of!r}"
        raise InputError(path, found, f"one for {scenario.name}, which is looked at")
    rows = sorted(table.to_pylist(), key=lambda row: row["order"])
    if [row["order"] for row in rows] != list(range(1, len(rows) + 1)) or not rows:
        raise InputError(path, f"its sensors have the orders {[row['order'] for row in rows]}", "1, 2, ... in turn")
    measured = {site.name: site.points for site in candidates_of(scenario)}
    sites = tuple(_site(path, row, measured.get(row["site"])) for row in rows)
    for site in sites:
        sensors.of_scenario(site.sensor, scenario, f"{path}: {site.name}")
        point_clouds.check(site)
    stages = about["stages"]
    return Plan(path, sites, str(about["plan"].get("score")), str(about["inputs"]), str(stages.get("statics", "")))


def _site(path: Path, row: dict[str, Any], points: str | None) -> Site:
    pose = Pose(**{field.name: row[field.name] for field in fields(Pose)})
    if not np.isfinite([*pose.position_m, *pose.angles_deg]).all():
        raise InputError(f"{path}: {row['site']}", f"its pose is {pose}", "finite numbers")
    return Site(row["site"], pose, row["sensor"], points, row["pole"])
