"""Inputs: what a scenario names - network, static world, sites, sensors, effects - resolved once per run.

Each part is resolved when it is first read, and then passed on in the context of the stages. The check stage looks at
the same parts, but one that is wrong must not hide the errors of the others: :func:`resolve_check_inputs` collects all
errors and leaves out what cannot be read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from egvs.artefacts.run_folder import RunFolder
from egvs.core.digests import Digests
from egvs.core.errors import Diagnostic, DiagnosticsError, InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.effects import registry
from egvs.formats import point_clouds
from egvs.formats.georeference import Georeference
from egvs.formats.meshes import referenced_files
from egvs.scenario.loading import check_is_scenario
from egvs.scenario.model import TERRAIN_KEY, Scenario
from egvs.scoring import zones
from egvs.sensors import sites
from egvs.sensors.scene import ActiveEffect, InactiveEffect, Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Site
from egvs.stages import scene_inputs
from egvs.traffic import sumo_folder
from egvs.traffic.network import Network
from egvs.world import geolocation, mesh, static_world
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World
from egvs.world.static_world import BuildCounts, SolidSource

if TYPE_CHECKING:
    from egvs.sensors.scanner import Scanner

T = TypeVar("T")

MISSING_FILE_RULE = "files"
"""Rule name of errors about files that do not exist."""

POINTS_KEY = "sites.points"
MISSING = "absent"
"""Takes the place of the digest of a file that does not exist."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """A scenario and what it names; each part is resolved when it is first read.

    Attributes
    ----------
    scenario
        The scenario.
    folder
        Run folder whose ``statics.ply`` holds the static world, unless it is built here; None to build it.
    progress
        Called while the static world is built.
    digests
        The digests of input files and artefacts.
    """

    scenario: Scenario
    folder: RunFolder | None = None
    progress: ProgressCallback = no_progress
    digests: Digests = field(default_factory=Digests)

    @cached_property
    def georeference(self) -> Georeference:
        """Where the world frame lies on the Earth; InputError where [crs] and the network disagree."""
        return geolocation.scenario_georeference(self.scenario)

    @cached_property
    def network(self) -> Network | None:
        """The road network; None where the scenario names none."""
        return sumo_folder.read_network(self.scenario)

    @cached_property
    def carriageway(self) -> Carriageway | None:
        """The areas of the network's lanes; None where there is no network, or it has no lane for road vehicles."""
        if self.network is None:
            return None
        carriageway = Carriageway.of(self.network)
        return carriageway if carriageway.lanes else None

    @cached_property
    def common_network(self) -> Network | None:
        """The network that the traffic of all periods drives on; None if there is no network or more than one."""
        if self.common_network_path is None:
            return None
        if not self.scenario.traffic.periods:
            return self.network
        return sumo_folder.read_network(next(iter(self.scenario.by_period().values())))

    @cached_property
    def common_network_path(self) -> Path | None:
        """The file of :attr:`common_network`."""
        paths = {sumo_folder.network_path(period) for period in self.scenario.by_period().values()}
        return paths.pop() if len(paths) == 1 else None

    @cached_property
    def built_world(self) -> tuple[World, BuildCounts]:
        """The static world built from the scenario's files, with counts of what went into it."""
        return static_world.build_world(self.scenario, registry.ground_effect(self.scenario), self.progress)

    @cached_property
    def world(self) -> World:
        """The static world: the built one, or that of ``statics.ply`` where the statics stage did not run."""
        is_built = "built_world" in self.__dict__
        if self.folder is None or is_built:
            return self.built_world[0]
        return mesh.read_ply(self.folder.statics)[0]

    @cached_property
    def candidates(self) -> tuple[Site, ...]:
        """All candidate sites, also those of a rule where no pole can stand."""
        return sites.candidate_sites(self.scenario)

    @cached_property
    def plain_scene(self) -> Scene:
        """The scene without effects; InputError when no site is left."""
        return scene_inputs.resolve_plain_scene(self.scenario, self.world, self.candidates)

    @cached_property
    def scene(self) -> Scene:
        """Static world, sites, sensors and active effects: the parts that beams need."""
        return scene_inputs.with_effects(self.plain_scene)

    @cached_property
    def scanner(self) -> Scanner:
        """The scanner of the scene, which can cast every site."""
        from egvs.sensors.scanner import Scanner

        scanner = Scanner(self.scene)
        scanner.check(self.scene.sites)
        return scanner

    @property
    def sites(self) -> tuple[Site, ...]:
        """The sites that are scanned and scored."""
        return self.scene.sites

    @property
    def sensors(self) -> dict[str, Sensor]:
        """The sensors of the sites, by name."""
        return self.scene.used_sensors

    @property
    def effects(self) -> tuple[ActiveEffect, ...]:
        """The effects of the scan and score stages that can change a result."""
        return self.scene.effects

    @property
    def inactive_effects(self) -> tuple[InactiveEffect, ...]:
        """The named effects of these stages that provably change nothing."""
        return self.scene.inactive_effects


def build_scene(scenario: Scenario) -> Scene:
    """Return the scene of a scenario, with the static world built in memory; nothing is written.

    Raises
    ------
    InputError
        When the scenario, or a file that it names, is wrong.
    """
    check_is_scenario(scenario)
    return Inputs(scenario).scene


def named_files(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield (key, file name) for every file that the scenario itself names."""
    statics, traffic, site_config = scenario.statics, scenario.traffic, scenario.sites
    yield from (("statics.footprints", name) for name in statics.footprints)
    yield from (("statics.polygons", name) for name in statics.polygons)
    yield from (("statics.meshes", mesh_config.file) for mesh_config in statics.meshes)
    if statics.terrain is not None:
        yield TERRAIN_KEY, statics.terrain
    yield from (("traffic.routes", name) for name in traffic.routes)
    yield from (("traffic.vtypes", name) for name in traffic.vtypes)
    yield from (("traffic.tracks", name) for name in traffic.tracks or ())
    yield from (("traffic.pedestrian_tracks", name) for name in traffic.pedestrian_tracks or ())
    for key, optional_name in (
        ("traffic.network", traffic.network),
        ("traffic.sumocfg", traffic.sumocfg),
        ("traffic.fcd", traffic.fcd),
        ("traffic.coverage", traffic.coverage),
        ("traffic.observed", traffic.observed),
        ("traffic.roads", traffic.roads),
        ("sites.file", site_config.file),
        (POINTS_KEY, site_config.points),
    ):
        if optional_name is not None:
            yield key, optional_name
    if scenario.score.zones is not None:
        yield zones.REPORTED_KEY, scenario.score.zones
    for name, weighted in scenario.score.weights.zones.items():
        if weighted.file is not None:
            yield f"{zones.WEIGHTS_KEY}.{name}.file", weighted.file
    for name, demand in scenario.placement.zones.items():
        if demand.file is not None:
            yield f"{zones.PLACEMENT_KEY}.{name}.file", demand.file
    for period in traffic.periods:
        prefix = f"traffic.periods ({period.name})"
        yield from ((f"{prefix}.routes", name) for name in period.routes)
        if period.sumocfg is not None:
            yield f"{prefix}.sumocfg", period.sumocfg
        if period.fcd is not None:
            yield f"{prefix}.fcd", period.fcd
        yield from ((f"{prefix}.tracks", name) for name in period.tracks or ())
    for sensor_name, model in scenario.sensors.items():
        if model.beam_file is not None:
            key, file = model.beam_file
            yield f"sensors.{sensor_name}.{key}", file


def measured_scan_files(candidates: Iterable[Site]) -> Iterator[tuple[str, str]]:
    """Yield (key, file name) for the measured scans of some sites."""
    for site in candidates:
        if site.points is not None:
            yield f"site {site.name}: points", site.points


def readable_candidates(inputs: Inputs) -> tuple[Site, ...]:
    """Return all candidate sites; none where they cannot be read, which another rule reports."""
    try:
        return inputs.candidates
    except InputError:
        return ()


def missing_files(inputs: Inputs) -> Iterator[Diagnostic]:
    """Yield an error for each file that does not exist, and for each measured scan in an unknown format."""
    scenario = inputs.scenario
    scans = [scan for scan in measured_scan_files(readable_candidates(inputs)) if scan[1] != scenario.sites.points]
    for key, name in (*named_files(scenario), *scans):
        try:
            scenario.find(name, key)
            if (key, name) in scans or key == POINTS_KEY:
                point_clouds.format_of_file(Path(name), key)
        except InputError as error:
            yield Diagnostic.of(MISSING_FILE_RULE, error)


def file_digests(inputs: Inputs) -> dict[str, str]:
    """Return the sha256 of every file that the check stage reads, ``MISSING`` if it does not exist.

    Measured scans are not opened; only whether they exist counts.
    """
    scenario = inputs.scenario
    digests = {}
    mesh_paths = []
    for key, name in named_files(scenario):
        digest = _file_presence(scenario, key, name)
        if digest != MISSING and key != POINTS_KEY:
            path = scenario.find(name, key)
            digest = inputs.digests.of(path)
            if key == "statics.meshes":
                mesh_paths.append(path)
        digests[f"{key} = {name}"] = digest
    for key, name in measured_scan_files(readable_candidates(inputs)):
        digests[f"{key} = {name}"] = _file_presence(scenario, key, name)

    paths = sumo_config_files(scenario)
    for path in mesh_paths:
        paths += referenced_files(path)
    for number, path in enumerate(paths):
        digests[f"{number}: {path.name}"] = inputs.digests.of(path)
    return digests


def _file_presence(scenario: Scenario, key: str, name: str) -> str:
    try:
        scenario.find(name, key)
    except InputError:
        return MISSING
    return "there"


def sumo_config_files(scenario: Scenario) -> list[Path]:
    """Return the files that the SUMO configurations of all periods name; none of one that is wrong."""
    paths = []
    for period in scenario.by_period().values():
        if period.traffic.sumocfg is None:
            continue
        try:
            paths += sumo_folder.demand_files(period).all()
        except InputError:  # another rule reports it
            continue
    return paths


@dataclass(frozen=True)
class CheckInputs:
    """The parts of :class:`Inputs` that could be read, for rules; a part is None where it is missing or wrong.

    Attributes
    ----------
    sites
        All candidates; of a rule those where a pole can stand, if the static world is known.
    scene
        Sites and static world, without effects.
    solid_sources
        Which solids of the static world each file has.
    complete
        What these parts are read from, with all periods; None where the scenario is complete.
    """

    scenario: Scenario
    network: Network | None = None
    carriageway: Carriageway | None = None
    world: World | None = None
    sites: tuple[Site, ...] = ()
    scene: Scene | None = None
    solid_sources: tuple[SolidSource, ...] = ()
    complete: Inputs | None = None

    @property
    def georeference(self) -> Georeference:
        """Where the world frame lies on the Earth, the same for all periods; InputError as in :class:`Inputs`."""
        return (self.complete or Inputs(self.scenario)).georeference

    def site_location(self, site: Site) -> str:
        """Return the file or key, and the name, of a site, for messages."""
        config = self.scenario.sites
        if config.file is not None:
            source = config.file
        elif config.grid is not None:
            source = "sites.grid"
        else:
            source = "sites.along"
        return f"{source}: site {site.name}"


@dataclass
class ErrorCollector:
    """Collects errors, so that all of them are reported at once."""

    findings: list[Diagnostic] = field(default_factory=list)

    def attempt(self, rule: str, make: Callable[[], T]) -> T | None:
        """Return the value of ``make``; None, and an error is added, where the input is wrong."""
        try:
            return make()
        except DiagnosticsError as error:
            self.findings += error.findings
            return None
        except InputError as error:
            self.findings.append(Diagnostic.of(rule, error))
            return None


def resolve_check_inputs(inputs: Inputs) -> tuple[CheckInputs, list[Diagnostic]]:
    """Read each part of the inputs by itself; return what could be read, and the errors."""
    scenario = inputs.scenario
    errors = ErrorCollector(list(missing_files(inputs)))
    network = errors.attempt("network", lambda: inputs.network)
    built = errors.attempt("statics", lambda: inputs.built_world)
    world = None if built is None else built[0]
    if world is None:
        errors.findings += _static_file_errors(scenario)
    errors.attempt("zones", lambda: zones.weight_zones(scenario))
    errors.attempt("zones", lambda: zones.placement_zones(scenario))
    errors.attempt("zones", lambda: zones.reported_zones(scenario))
    carriageway = None if network is None else inputs.carriageway
    sources = () if built is None else tuple(built[1].sources)
    readable = CheckInputs(scenario, network, carriageway, world, solid_sources=sources, complete=inputs)

    candidates = errors.attempt("sites", lambda: inputs.candidates)
    if candidates is None:
        return readable, errors.findings
    readable = replace(readable, sites=candidates)
    if world is not None:
        scene = errors.attempt("sites", lambda: inputs.plain_scene)
        if scene is not None:
            readable = replace(readable, sites=scene.sites, scene=scene)
    return readable, errors.findings


def _static_file_errors(scenario: Scenario) -> Iterator[Diagnostic]:
    """The errors of each file of static geometry, read by itself."""
    config = scenario.statics
    nothing = config.model_copy(update={"footprints": (), "polygons": (), "meshes": ()})
    for key in ("footprints", "polygons", "meshes"):
        for file in getattr(config, key):
            statics = nothing.model_copy(update={key: (file,)})
            errors = ErrorCollector()
            errors.attempt(
                "statics", partial(static_world.build_world, scenario.model_copy(update={"statics": statics}))
            )
            yield from errors.findings
