"""The check stage: what can be refused is refused before anything costly, and doubts are told; it writes no file.

Steps: read what the scenario names; ask every rule (:mod:`pipeline.checks.checking`). All errors stop the run at once;
warnings stay in the stage's summary.
"""

from __future__ import annotations

from typing import Any

from pipeline.checks import checking, files
from pipeline.core.errors import InputError
from pipeline.core.findings import WARNINGS, FindingsError
from pipeline.scenario.models import Scenario
from pipeline.sensing.sites import Site
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.stages.shared.built import built
from pipeline.stages.shared.scene import sensor_digests
from pipeline.world import world_frame

NAME = "check"
ARTEFACTS = ()


def inputs(work: Workspace) -> StageInputs:
    """Every file by hash, and all settings but voxels and those of what comes of a run (:data:`UNREAD`)."""
    scenario = work.scenario
    candidates = files.sound_sites(scenario)
    hashes = files.digests(scenario, candidates) | _sensors(scenario, candidates)
    settings = scenario.model_dump(mode="json", exclude={**dict.fromkeys(UNREAD, True), "roi": {"voxel_m"}})
    settings["keep_visibility"] = scenario.score.keep_visibility
    if scenario.traffic.periods:  # whose frames that fill no block have no weight
        settings["blocks"] = scenario.tpog.blocks
    settings |= _world(scenario)
    return StageInputs(settings, hashes)


def _sensors(scenario: Scenario, candidates: tuple[Site, ...]) -> dict[str, str]:
    """Beam tables and entries of the catalogue, by hash; none where one is not there, which is known already."""
    try:
        return sensor_digests(scenario, candidates)
    except InputError:
        return {}


def _world(scenario: Scenario) -> dict[str, Any]:
    """Where the world frame lies, and the SUMO that converts a map; nothing where that is wrong, which is told."""
    try:
        return world_frame.key(scenario)
    except InputError:
        return {}


UNREAD = ("description", "extends", "seed", "tpog", "scan", "score", "validation", "placement", "costs")


def run(work: Workspace, inputs: StageInputs) -> Summary:
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
    checked = checking.check(work.scenario, lambda _: built(work)[0])
    if checked.errors:
        raise FindingsError(checked.errors, checked.warnings)
    counts = {"sites": checked.sites, "solids": checked.solids, "lanes": checked.lanes}
    return {**counts, WARNINGS: [finding.to_json() for finding in checked.warnings]}
