"""Every file that a scenario names is there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.traffic import sumo_folder

FCD = "traffic.fcd"
ABSENT = "absent"


def named(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """(key, file name) of every file that the scenario itself names."""
    statics, traffic, of_sites = scenario.statics, scenario.traffic, scenario.sites
    yield from (("statics.footprints", name) for name in statics.footprints)
    yield from (("statics.polygons", name) for name in statics.polygons)
    yield from (("statics.meshes", mesh.file) for mesh in statics.meshes)
    yield from (("traffic.routes", name) for name in traffic.routes)
    for key, name in (
        ("traffic.network", traffic.network), ("traffic.sumocfg", traffic.sumocfg), (FCD, traffic.fcd),
        ("sites.file", of_sites.file), ("sites.points", of_sites.points),
    ):  # fmt: skip
        if name is not None:
            yield key, name


def missing(scenario: Scenario) -> Iterator[Finding]:
    """An error for each file that is not there."""
    for key, name in named(scenario):
        try:
            scenario.find(name, key)
        except InputError as error:
            yield Finding.of("files", error)


def measured(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """(key, file name) of the measured scans that a file of sites names; none where that file is wrong."""
    try:
        candidates = sites.of(scenario) if scenario.sites.file is not None else ()
    except InputError:
        return
    yield from ((f"site {site.name}: points", site.points) for site in candidates if site.points is not None)


def digests(scenario: Scenario) -> dict[str, str]:
    """Hash of every file that the check reads, ``ABSENT`` where it is not there; of a finished FCD file the name only,
    since that is not opened."""
    wanted = [*((key, name) for key, name in named(scenario)), *measured(scenario)]
    found = {f"{key} = {name}": _digest(scenario, key, name) for key, name in wanted}
    if scenario.traffic.sumocfg is not None:
        try:
            paths = sumo_folder.sources(scenario).all()
        except InputError:
            paths = []
        found |= {f"{number}: {path.name}": files.sha256_of(path) for number, path in enumerate(paths)}
    return found


def _digest(scenario: Scenario, key: str, name: str) -> str:
    try:
        path: Path = scenario.find(name, key)
    except InputError:
        return ABSENT
    return "there" if key == FCD else files.sha256_of(path)
