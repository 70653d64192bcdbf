"""The check stage: everything that can be rejected is rejected before any costly work; it writes no file.

Steps: read what the scenario names, once (:func:`egvs.stages.inputs.resolve_check_inputs`); apply every rule of
:data:`RULES`. All errors stop the run at once; warnings stay in the summary of the stage. Nothing is simulated or cast.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from egvs.core.errors import WARNINGS_KEY, Diagnostic, DiagnosticsError, InputError
from egvs.core.wording import list_first
from egvs.effects import registry
from egvs.scenario.model import Scenario
from egvs.sensors.sites import Site
from egvs.stages import height_checks, name_checks, scene_checks, scene_inputs, solid_readings, traffic_checks
from egvs.stages import inputs as stage_inputs
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.inputs import CheckInputs, Inputs
from egvs.stages.scene_checks import PoleSurroundings
from egvs.stages.scene_dependencies import sensor_digests
from egvs.traffic import traffic_sources
from egvs.world import geolocation

RULES: tuple[Callable[[CheckInputs], Iterator[Diagnostic]], ...] = (
    scene_checks.check_lanes_in_region,
    scene_checks.check_period_networks,
    traffic_checks.check_times,
    traffic_checks.check_sumo_files,
    traffic_checks.check_sumo_locations,
    traffic_checks.check_period_weights,
    traffic_checks.check_demand,
    traffic_checks.check_internal_edges,
    traffic_checks.check_signals,
    traffic_checks.warn_equal_demand,
    traffic_checks.check_recorded_positions,
    traffic_checks.check_finished_files,
    traffic_checks.check_vehicle_kinds,
    traffic_checks.warn_vehicle_sizes,
    traffic_checks.check_counts,
    traffic_checks.check_observed,
    name_checks.check_similar_names,
    scene_checks.check_sensors_known,
    scene_checks.warn_repeated_beams,
    scene_checks.warn_odd_beams,
    scene_checks.check_effects,
    scene_checks.warn_losses,
    scene_checks.check_poses,
    scene_checks.warn_radians,
    scene_checks.warn_nose_up,
    scene_checks.warn_upward_beams,
    scene_checks.warn_equal_sites,
    scene_checks.warn_sites_on_lanes,
    scene_checks.warn_own_supports,
    scene_checks.warn_dropped_sites,
    scene_checks.warn_solids_over_lanes,
    scene_checks.warn_walls_over_lanes,
    scene_checks.warn_repeated_solids,
    scene_checks.warn_solids_far_away,
    solid_readings.warn_mesh_axes,
    height_checks.warn_low_sites,
    height_checks.check_heights,
    traffic_checks.check_traffic_heights,
)
"""In the order in which findings are reported. A new rule is a function in this list."""

_SCENE_MODULES = (scene_checks.__name__, name_checks.__name__, solid_readings.__name__, height_checks.__name__)
"""Modules of rules that read no traffic."""

_RECORDED_TRAFFIC_KEY = "fcd"
"""Last part of the keys that name files of recorded traffic."""


NOTES = ("own supports",)
"""Rules of what is as intended, and is said only where details are asked for."""


@dataclass(frozen=True)
class CheckReport:
    """Findings of a check.

    Attributes
    ----------
    findings
        Errors and warnings, errors first.
    sites, solids, lanes
        How many were checked.
    poles
        Where each pole stands, from :func:`check_scenario`.
    """

    findings: tuple[Diagnostic, ...]
    sites: int
    solids: int
    lanes: int
    poles: tuple[PoleSurroundings, ...] = ()

    @property
    def errors(self) -> tuple[Diagnostic, ...]:
        """The findings that stop a run."""
        return tuple(finding for finding in self.findings if finding.is_error)

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """The findings that do not stop a run, and are no notes."""
        return tuple(finding for finding in self.findings if not finding.is_error and finding.rule not in NOTES)

    @property
    def notes(self) -> tuple[Diagnostic, ...]:
        """The findings of the rules in :data:`NOTES`."""
        return tuple(finding for finding in self.findings if finding.rule in NOTES)


@dataclass(frozen=True)
class SceneReport:
    """A scene without errors, checked before its traffic is known.

    Attributes
    ----------
    warnings
        Warnings of each rule that reads no traffic, by the name of the rule.
    sites, solids, lanes
        How many were checked.
    """

    warnings: Mapping[str, tuple[Diagnostic, ...]]
    sites: int
    solids: int
    lanes: int

    def to_json(self) -> dict[str, Any]:
        """Return a JSON value."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> SceneReport:
        """Invert :meth:`to_json`."""
        warnings = {}
        for rule, findings in values["warnings"].items():
            warnings[rule] = tuple(Diagnostic(**finding) for finding in findings)
        return cls(warnings, values["sites"], values["solids"], values["lanes"])


def check_scenario(scenario: Scenario) -> CheckReport:
    """Apply every rule to a scenario, see :func:`check_inputs`, and describe where each pole stands."""
    inputs = Inputs(scenario)
    report = check_inputs(inputs)
    if report.errors:
        return report
    readable, _ = stage_inputs.resolve_check_inputs(inputs)
    return replace(report, poles=scene_checks.pole_surroundings(readable))


def check_inputs(inputs: Inputs, scene: SceneReport | None = None) -> CheckReport:
    """Apply every rule to the inputs of a scenario.

    Parameters
    ----------
    inputs
        The inputs.
    scene
        From :func:`check_scene` of the same scene; then only the rules that read traffic are applied.

    Raises
    ------
    RunError
        When a program that reads a file is missing or fails; errors of the input are among the findings.
    """
    if scene is None:
        readable, findings = stage_inputs.resolve_check_inputs(inputs)
        counts = _count_checked(readable)
    else:
        readable, findings = (
            CheckInputs(inputs.scenario, inputs.network, complete=inputs),
            list(stage_inputs.missing_files(inputs)),
        )
        counts = scene.sites, scene.solids, scene.lanes
    for rule in RULES:
        if scene is not None and rule.__name__ in scene.warnings:
            findings += scene.warnings[rule.__name__]
        else:
            findings += rule(readable)
    unique = _merge_findings(_drop_repeated_missing_files(findings))
    return CheckReport(tuple(sorted(unique, key=lambda finding: not finding.is_error)), *counts)


def check_scene(inputs: Inputs) -> SceneReport | None:
    """Apply the rules that read no traffic, so that the files of recorded traffic need not exist yet.

    Parameters
    ----------
    inputs
        The inputs.

    Returns
    -------
    SceneReport or None
        None where the complete check is necessary: the scene has errors, or an effect that adds traffic.
    """
    if registry.scenario_effects(inputs.scenario, "traffic"):  # it may read the traffic
        return None
    readable, findings = stage_inputs.resolve_check_inputs(inputs)
    if any(finding.rule != stage_inputs.MISSING_FILE_RULE for finding in findings):
        return None
    warnings = {}
    for rule in RULES:
        if rule.__module__ not in _SCENE_MODULES:
            continue
        warnings[rule.__name__] = tuple(rule(readable))
        if any(finding.is_error for finding in warnings[rule.__name__]):
            return None
    return SceneReport(warnings, *_count_checked(readable))


def _count_checked(readable: CheckInputs) -> tuple[int, int, int]:
    """Return the numbers of sites, solids and lanes."""
    n_solids = 0 if readable.world is None else len(readable.world.solids)
    n_lanes = 0 if readable.carriageway is None else len(readable.carriageway.lanes)
    return len(readable.sites), n_solids, n_lanes


def _drop_repeated_missing_files(findings: Sequence[Diagnostic]) -> Iterator[Diagnostic]:
    """Drop what other rules report about missing files, which are reported where the scenario names them."""
    missing = {finding.problem for finding in findings if finding.rule == stage_inputs.MISSING_FILE_RULE}
    for finding in findings:
        if finding.rule == stage_inputs.MISSING_FILE_RULE or finding.problem not in missing:
            yield finding


def _merge_findings(findings: Iterable[Diagnostic]) -> Iterator[Diagnostic]:
    """Join findings that differ only in the file or key; the first of these is named."""
    by_text: dict[tuple[str, str, bool], dict[str, Diagnostic]] = {}
    for finding in findings:
        by_text.setdefault((finding.problem, finding.hint, finding.is_error), {}).setdefault(finding.where, finding)
    for equal in by_text.values():
        first = next(iter(equal.values()))
        yield replace(first, where=list_first(list(equal), 1))


IGNORED_SETTINGS = (
    "description", "extends", "seed", "tpog", "scan", "score", "validation", "placement", "costs", "what_if",
)  # fmt: skip
"""Settings that no rule reads."""


def dependencies(context: StageContext) -> StageDependencies:
    """Return what the check depends on: every file by hash, and all settings except :data:`IGNORED_SETTINGS`."""
    scenario = context.scenario
    candidates = stage_inputs.readable_candidates(context.inputs)
    digests = stage_inputs.file_digests(context.inputs) | _sensor_digests(scenario, candidates)
    settings = scenario.model_dump(mode="json", exclude={**dict.fromkeys(IGNORED_SETTINGS, True), "roi": {"voxel_m"}})
    settings["keep_visibility"] = scenario.score.keep_visibility
    if scenario.traffic.periods:  # frames of a period that fill no block have no weight
        settings["blocks"] = scenario.tpog.blocks
    settings |= _georeference_settings(scenario)
    return StageDependencies(settings, digests, modules=_source_modules(scenario))


def scene_dependencies(context: StageContext) -> StageDependencies:
    """Return what :func:`check_scene` depends on: as :func:`dependencies`, without the files of recorded traffic."""
    complete = dependencies(context)
    digests = {}
    for label, digest in complete.files.items():
        key = label.partition(" = ")[0]
        if key.rpartition(".")[2] != _RECORDED_TRAFFIC_KEY:
            digests[label] = digest
    return replace(complete, files=digests)


def _sensor_digests(scenario: Scenario, candidates: tuple[Site, ...]) -> dict[str, str]:
    """The sha256 of beam tables and catalogue entries; nothing where one is missing, which a rule reports."""
    try:
        return sensor_digests(scenario, candidates)
    except InputError:
        return {}


def _source_modules(scenario: Scenario) -> tuple[str, ...]:
    """The modules that read recorded traffic; nothing where they cannot be found, which a rule reports."""
    modules: dict[str, None] = {}
    for period in scenario.by_period().values():
        try:
            modules |= dict.fromkeys(traffic_sources.loaded_modules(period))
        except InputError:
            continue
    return tuple(modules)


def _georeference_settings(scenario: Scenario) -> dict[str, Any]:
    """Settings of the world frame and of the conversion of a map; nothing where a rule reports them as wrong."""
    try:
        return geolocation.world_frame_settings(scenario)
    except InputError:
        return {}


def run(
    context: StageContext,
    _inputs: StageDependencies,
    scene_report: Callable[[StageContext], SceneReport | None] = lambda _: None,
) -> Summary:
    """Apply every rule.

    Parameters
    ----------
    context
        The inputs.
    scene_report
        Returns the result of :func:`check_scene` of this scene if it is known.

    Returns
    -------
    dict
        Number of ``sites`` (those that are scanned), ``solids`` and ``lanes`` that were checked; ``losses``: for which
        sensors losses of returns are simulated; warnings.

    Raises
    ------
    DiagnosticsError
        With all errors and warnings.
    """
    report = check_inputs(context.inputs, scene_report(context))
    if report.errors:
        raise DiagnosticsError(report.errors, report.warnings)
    summary: Summary = {"sites": report.sites, "solids": report.solids, "lanes": report.lanes}
    losses = scene_inputs.scenario_losses(context.scenario, context.inputs.candidates)
    if losses is not None and losses.notes:
        summary["losses"] = list(losses.notes)
    if report.notes:
        summary["notes"] = [finding.problem for finding in report.notes]
    summary[WARNINGS_KEY] = [finding.to_json() for finding in report.warnings]
    return summary


STAGE = Stage(
    "check",
    __name__,
    dependencies,
    run,
    effect_stages=("traffic", "scan", "score"),
    neutral_options=("scene_report",),
    reads_traffic=True,
)
