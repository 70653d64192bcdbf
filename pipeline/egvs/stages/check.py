"""The check stage and its list of rules.

Holds a scenario's sites, solids, region of interest, lanes, traffic and sensors against one another.

:func:`check_scenario` reads what the scenario names once, asks every rule, and gives all findings at once, errors
first. Nothing
is simulated, cast or written.

The check stage: what can be refused is refused before anything costly, and doubts are told; it writes no file.

Steps: read what the scenario names; ask every rule (:mod:`egvs.stages.check`). All errors stop the run at once;
warnings stay in the stage's summary.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from egvs.core.errors import WARNINGS_KEY, Diagnostic, DiagnosticsError, InputError
from egvs.scenario.model import Scenario
from egvs.sensors.sites import Site
from egvs.stages import inputs as stage_inputs
from egvs.stages import scene_checks, traffic_checks
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.inputs import CheckInputs, Inputs
from egvs.stages.scene_inputs import sensor_digests
from egvs.world import geolocation

RULES: tuple[Callable[[CheckInputs], Iterator[Diagnostic]], ...] = (
    scene_checks.check_lanes_in_region, scene_checks.check_period_networks, traffic_checks.check_times,
    traffic_checks.check_sumo_files, traffic_checks.check_period_weights, traffic_checks.check_demand,
    traffic_checks.check_recorded_positions, traffic_checks.check_finished_files,
    traffic_checks.check_vehicle_kinds, traffic_checks.check_counts, scene_checks.check_sensors_known,
    scene_checks.warn_repeated_beams,
    scene_checks.check_effects, scene_checks.check_poses, scene_checks.warn_sites_on_lanes,
    scene_checks.warn_dropped_sites, scene_checks.warn_solids_over_lanes, scene_checks.warn_solids_far_away,
)  # fmt: skip
"""In the order in which findings are told. A further rule is a function here."""


@dataclass(frozen=True)
class CheckReport:
    """What a check found, and how much was held against one another.

    Attributes
    ----------
    findings
        Errors first.
    sites, solids, lanes
        How many there are.
    """

    findings: tuple[Diagnostic, ...]
    sites: int
    solids: int
    lanes: int

    @property
    def errors(self) -> tuple[Diagnostic, ...]:
        """What must stop a run."""
        return tuple(finding for finding in self.findings if finding.is_error)

    @property
    def warnings(self) -> tuple[Diagnostic, ...]:
        """What a planner has to know."""
        return tuple(finding for finding in self.findings if not finding.is_error)


def check_scenario(scenario: Scenario) -> CheckReport:
    """Apply every rule to a scenario; see :func:`check_inputs`."""
    return check_inputs(Inputs(scenario))


def check_inputs(inputs: Inputs) -> CheckReport:
    """Apply every rule to what a scenario names.

    Raises
    ------
    RunError
        When a program that reads a file is not there or fails; what is wrong with the input is among the findings.
    """
    readable, findings = stage_inputs.resolve_check_inputs(inputs)
    for rule in RULES:
        findings += rule(readable)
    unique = _merge_findings(_drop_repeated_missing_files(findings))
    return CheckReport(
        tuple(sorted(unique, key=lambda finding: not finding.is_error)),
        len(readable.sites),
        0 if readable.world is None else len(readable.world.solids),
        0 if readable.carriageway is None else len(readable.carriageway.lanes),
    )


def _drop_repeated_missing_files(findings: Sequence[Diagnostic]) -> Iterator[Diagnostic]:
    """Without what rules say of files that are not there: that is told already, where the scenario names them."""
    absent = {finding.problem for finding in findings if finding.rule == stage_inputs.MISSING_FILE_RULE}
    return (
        finding
        for finding in findings
        if finding.rule == stage_inputs.MISSING_FILE_RULE or finding.problem not in absent
    )


def _merge_findings(findings: Iterable[Diagnostic]) -> Iterator[Diagnostic]:
    """Each finding once; those that say the same of several places as one, which names the first."""
    places: dict[tuple[str, str, bool], dict[str, Diagnostic]] = {}
    for finding in findings:
        places.setdefault((finding.problem, finding.hint, finding.is_error), {}).setdefault(finding.where, finding)
    for first, *others in (list(alike.values()) for alike in places.values()):
        yield replace(first, where=f"{first.where} and {len(others)} more") if others else first


def dependencies(work: StageContext) -> StageDependencies:
    """Every file by hash, and all settings but voxels and those of what comes of a run (:data:`IGNORED_SETTINGS`)."""
    scenario = work.scenario
    candidates = stage_inputs.readable_candidates(work.inputs)
    hashes = stage_inputs.file_digests(work.inputs) | _sensor_digests(scenario, candidates)
    settings = scenario.model_dump(mode="json", exclude={**dict.fromkeys(IGNORED_SETTINGS, True), "roi": {"voxel_m"}})
    settings["keep_visibility"] = scenario.score.keep_visibility
    if scenario.traffic.periods:  # whose frames that fill no block have no weight
        settings["blocks"] = scenario.tpog.blocks
    settings |= _georeference_settings(scenario)
    return StageDependencies(settings, hashes)


def _sensor_digests(scenario: Scenario, candidates: tuple[Site, ...]) -> dict[str, str]:
    """Beam tables and entries of the catalogue, by hash; none where one is not there, which is known already."""
    try:
        return sensor_digests(scenario, candidates)
    except InputError:
        return {}


def _georeference_settings(scenario: Scenario) -> dict[str, Any]:
    """Where the world frame lies, and the SUMO that converts a map; nothing where that is wrong, which is told."""
    try:
        return geolocation.world_frame_settings(scenario)
    except InputError:
        return {}


IGNORED_SETTINGS = ("description", "extends", "seed", "tpog", "scan", "score", "validation", "placement", "costs")


def run(work: StageContext, inputs: StageDependencies) -> Summary:
    """Ask every rule.

    Returns
    -------
    dict
        ``sites`` (those that are scanned), ``solids`` and ``lanes`` that were held against one another; warnings.

    Raises
    ------
    FindingsError
        With all errors, and the warnings beside them.
    """
    del inputs
    checked = check_inputs(work.inputs)
    if checked.errors:
        raise DiagnosticsError(checked.errors, checked.warnings)
    counts = {"sites": checked.sites, "solids": checked.solids, "lanes": checked.lanes}
    return {**counts, WARNINGS_KEY: [finding.to_json() for finding in checked.warnings]}


STAGE = Stage("check", __name__, dependencies, run, effect_stages=("traffic", "scan", "score"))
