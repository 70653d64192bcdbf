"""Every file that a scenario names is there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from pipeline.checks.mesh_parts import pulled_in
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.formats import point_clouds
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.sensing.sites import Site
from pipeline.traffic import sumo_folder

RULE = "files"
"""Under which a file that is not there is found."""
UNOPENED = "sites.points"
ABSENT = "absent"


def named(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """(key, file name) of every file that the scenario itself names."""
    statics, traffic, of_sites = scenario.statics, scenario.traffic, scenario.sites
    yield from (("statics.footprints", name) for name in statics.footprints)
    yield from (("statics.polygons", name) for name in statics.polygons)
    yield from (("statics.meshes", mesh.file) for mesh in statics.meshes)
    yield from (("traffic.routes", name) for name in traffic.routes)
    yield from (("traffic.vtypes", name) for name in traffic.vtypes)
    for key, name in (
        ("traffic.network", traffic.network), ("traffic.sumocfg", traffic.sumocfg), ("traffic.fcd", traffic.fcd),
        ("traffic.roads", traffic.roads),
        ("sites.file", of_sites.file), ("sites.points", of_sites.points),
    ):  # fmt: skip
        if name is not None:
            yield key, name
    for period in traffic.periods:
        given = (("routes", name) for name in period.routes)
        for key, name in (*given, ("sumocfg", period.sumocfg), ("fcd", period.fcd)):
            if name is not None:
                yield f"traffic.periods ({period.name}).{key}", name
    for sensor, model in scenario.sensors.items():
        if model.beams is not None:
            yield f"sensors.{sensor}.beams", model.beams


def missing(scenario: Scenario) -> Iterator[Finding]:
    """An error for each file that is not there, and for each measured scan that nothing can read."""
    scans = [scan for scan in measured(sound_sites(scenario)) if scan[1] != scenario.sites.points]
    for key, name in (*named(scenario), *scans):
        try:
            scenario.find(name, key)
            if (key, name) in scans or key == "sites.points":
                point_clouds.reader_of(Path(name), key)
        except InputError as error:
            yield Finding.of(RULE, error)


def sound_sites(scenario: Scenario) -> tuple[Site, ...]:
    """All candidates; none where they cannot be read, which is told elsewhere."""
    try:
        return sites.of(scenario)
    except InputError:
        return ()


def measured(candidates: Iterable[Site]) -> Iterator[tuple[str, str]]:
    """(key, file name) of the measured scans of some sites."""
    yield from ((f"site {site.name}: points", site.points) for site in candidates if site.points is not None)


def digests(scenario: Scenario, candidates: Iterable[Site]) -> dict[str, str]:
    """Hash of every file that the check reads, ``ABSENT`` where it is not there.

    Of measured scans, which it does not open, only whether they are there.
    """
    found = {f"{key} = {name}": _digest(scenario, key, name) for key, name in named(scenario)}
    found |= {f"{key} = {name}": _presence(scenario, key, name) for key, name in measured(candidates)}
    meshes = [
        scenario.find(n, key) for key, n in named(scenario)
        if key == "statics.meshes" and found[f"{key} = {n}"] != ABSENT
    ]  # fmt: skip
    paths = [*configured(scenario), *(part for path in meshes for part in pulled_in(path))]
    return found | {f"{number}: {path.name}": files.sha256_of(path) for number, path in enumerate(paths)}


def configured(scenario: Scenario) -> list[Path]:
    """What the configurations of SUMO name, of all periods."""
    return [path for alone in scenario.by_period().values() for path in _configured(alone)]


def _configured(scenario: Scenario) -> list[Path]:
    """What a configuration of SUMO names; nothing where it is wrong, which is told elsewhere."""
    if scenario.traffic.sumocfg is None:
        return []
    try:
        return sumo_folder.sources(scenario).all()
    except InputError:
        return []


def _digest(scenario: Scenario, key: str, name: str) -> str:
    presence = _presence(scenario, key, name)
    if presence == ABSENT or key == UNOPENED:
        return presence
    return files.sha256_of(scenario.find(name, key))


def _presence(scenario: Scenario, key: str, name: str) -> str:
    try:
        scenario.find(name, key)
    except InputError:
        return ABSENT
    return "there"
