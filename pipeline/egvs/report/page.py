"""The report stage: writes ``report.html``, one file that presents a run and loads nothing from elsewhere.

Steps: read the artefacts, draw the figures (:mod:`egvs.drawing.run_figures`), fill the template.

The page depends on the artefacts and on the records of the earlier stages in ``run.json``, including their costs, but
on no time, path or machine: the same costs give the same bytes. Stages that were run one by one from a notebook leave
no ``run.json``; the page then says that costs are unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.artefacts.readers import DISTINCT_PROBABILITY, MIN_VEHICLES, PeriodRanking, read_blindspots
from egvs.artefacts.run_folder import ACCURACY_FILES, PLACEMENT_FILES, RunFolder
from egvs.artefacts.run_record import RunRecord, StageRecord, traffic_summary
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files
from egvs.core.errors import WARNINGS_KEY, collect_warnings
from egvs.drawing import maps, pages
from egvs.drawing import run_figures as figures
from egvs.drawing.basemap import network_file
from egvs.drawing.run_figures import Figures
from egvs.report import sensor_text
from egvs.report.extension_sections import (
    SectionContents,
    read_sections,
    report_sections,
    section_dependencies,
    section_modules,
)
from egvs.report.points_section import MAPPED_POLES, PointsSection
from egvs.report.ranking_text import (
    egvs_setting,
    entropy_seen_note,
    headline,
    lead,
    noticed_preference,
    ranking_disagreement,
    recorded_frames_hint,
    short_lead,
)
from egvs.report.reliability import by_severity, describe_reliability
from egvs.report.sections import (
    NAMED_POLES,
    assumes_flows,
    assumptions,
    busiest_counts,
    describe_counts,
    describe_missing_traffic,
    describe_poles_on_road,
    main_assumptions,
    study_values,
)
from egvs.report.sensor_text import (
    LOSSES_EVIDENCE,
    costs_option,
    describe_evidence,
    explain_sensor_differences,
    has_losses,
    range_note,
)
from egvs.results import labels as formatting
from egvs.results.labels import SCORE_LABELS
from egvs.results.levels import GROUPS_NOTE, DetectionLevel, GroupLevel, read_levels
from egvs.results.map_credits import read_map_credits
from egvs.results.ranking import RankedSite, Ranking, share_of_limit, site_titles
from egvs.results.sensors import SensorComparison
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import NOTICED
from egvs.sensors.sites import Site, has_relief
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.scene_dependencies import scan_dependencies

if TYPE_CHECKING:
    from jinja2 import Environment

    from egvs.report.approach_fits import ApproachFit
    from egvs.report.what_if_section import WhatIfSection
    from egvs.report.zone_section import ZoneSection
    from egvs.results.command_entries import Entries
    from egvs.results.plans import SensorPlan

STAGES = ("check", "traffic", "statics", "tpog", "scan", "score")
"""Stages whose costs and artefacts the page shows, in its order."""

LISTED, FIRST, LAST = 40, 30, 5
"""With more than ``LISTED`` sites, the tables show only the first and the last of them."""

CHOOSABLE = 200
"""A reader can choose at most this number of sites; the data of each takes some 20 kB."""

TEMPLATES = Path(__file__).parent / "templates"

_OPTIONAL_FILES = (
    RunFolder.scores_by_period.name,
    RunFolder.levels.name,
    RunFolder.blindspots.name,
    RunFolder.zones.name,
    RunFolder.plan_zones.name,
    *ACCURACY_FILES,
    *PLACEMENT_FILES,
    RunFolder.what_if.name,
)

_UNMODELLED = (
    ("occlusion between vehicles (in the EGVS)", "moving_occlusion"),
    ("rain", "rain"),
    ("fog", "fog"),
    ("attenuation of beams with distance", "range_limit"),
    ("partly transparent foliage", "foliage"),
    ("pedestrians and cyclists", "pedestrians_bicycles"),
    ("dirt and glare", ""),
)
"""What a scenario without effects does not model, and the effect that does."""


@dataclass(frozen=True)
class PageContents:
    """Everything that the page shows.

    Attributes
    ----------
    stages
        Records of the stages, as far as ``run.json`` has them, in the order of :data:`STAGES`.
    study, by_period, plan
        Results of other commands and of periods; None if those commands have not run.
    what_if
        Results of what-ifs; None without any.
    levels
        What detectors find and people notice of each group of road users from the best site.
    zones, points
        Road users found in zones, and maps of points on target; None where the scenario has no zones or no lanes.
    movements
        What each counted location is in words; empty if the run folder has no network.
    approaches
        Observed and simulated queues and speeds.
    approach_map
        SVG with the names and counts of the approaches; empty without counts.
    sections
        Sections of extensions.
    titles
        What people call the sites, by their names.
    answer_map
        SVG of the best site or the plan; empty without a map.
    """

    scenario: Scenario
    ranking: Ranking
    tpog: Tpog
    figures: Figures
    stages: Mapping[str, StageRecord]
    study: Mapping[str, Any] = field(default_factory=lambda: {"study": None})
    by_period: PeriodRanking | None = None
    plan: Mapping[str, Any] | None = None
    movements: Mapping[str, str] = field(default_factory=dict)
    what_if: WhatIfSection | None = None
    zones: ZoneSection | None = None
    levels: tuple[GroupLevel, ...] = ()
    points: PointsSection | None = None
    approaches: tuple[ApproachFit, ...] = ()
    approach_map: str = ""
    sections: tuple[SectionContents, ...] = ()
    titles: Mapping[str, str] = field(default_factory=dict)
    answer_map: str = ""


@dataclass(frozen=True)
class SiteListing:
    """The sites that tables list, first and last, and those that a reader can choose."""

    first: tuple[RankedSite, ...]
    last: tuple[RankedSite, ...]
    choices: tuple[RankedSite, ...]
    hidden: int
    all_choosable: bool

    @classmethod
    def from_ranking(cls, ranking: Ranking) -> SiteListing:
        """Select the sites of a ranking."""
        sites = choices = first = ranking.sites
        last: tuple[RankedSite, ...] = ()
        if len(sites) > LISTED:
            first, last = sites[:FIRST], sites[-LAST:]
        if len(sites) > CHOOSABLE:
            choices = sites[: CHOOSABLE - LAST] + sites[-LAST:]
        return cls(first, last, choices, len(sites) - len(first) - len(last), len(choices) == len(sites))


def dependencies(work: StageContext) -> StageDependencies:
    """Return the artefacts by hash, the summaries and costs of the earlier stages, and the settings on the page."""
    scenario, stages = work.scenario, _recorded_stages(work.folder.path)
    names = [RunFolder.trajectories.name, RunFolder.tpog.name, RunFolder.statics.name, RunFolder.scores.name]
    settings: dict[str, Any] = {"shown": _displayed_settings(scenario), "keep": scenario.scan.keep}
    if scenario.traffic.observed is not None:
        from egvs.traffic import observed

        settings["observed"] = work.inputs.digests.of(scenario.find(scenario.traffic.observed, observed.KEY))
        settings["counts"] = describe_counts(scenario, network_file(work.folder.path))
    if map_credits := read_map_credits(scenario):
        settings["map_credits"] = map_credits
    if current := _current_what_ifs(work, stages):
        settings["what_if"] = list(current)
    hashes: dict[str, str] = {}
    if scenario.scan.keep:
        names.append(RunFolder.scans.name)
    else:
        scan = scan_dependencies(work)
        settings["scan"], hashes = scan.settings, dict(scan.files)
    for section in report_sections():
        names += section.files
    hashes |= work.digests(*(name for name in (*names, *_OPTIONAL_FILES) if work.path(name).is_file()))
    network = work.inputs.common_network_path
    if network is not None:
        hashes["network"] = work.inputs.digests.of(network)
    if (roads := network_file(work.folder.path)) is not None:
        hashes |= work.digests(roads.relative_to(work.folder.path).as_posix())

    summaries = {}
    for name in ("traffic", "statics"):
        if name in stages:
            summary = dict(stages[name].summary)
            for key in ("sumo_seconds", "sumo_peak_mb"):  # differ from run to run, and are not shown
                summary.pop(key, None)
            summaries[name] = summary
    costs = {name: [stage.cost.seconds, stage.cost.peak_mb] for name, stage in stages.items()}
    warnings = [stage.summary.get(WARNINGS_KEY, []) for stage in stages.values()]
    more = {"costs": costs, "summaries": summaries, "warnings": warnings}
    if "check" in stages:
        more["losses"] = stages["check"].summary.get("losses", [])
    more["sections"] = section_dependencies(work.folder, scenario, stages)
    return StageDependencies(settings, hashes, more, section_modules())


def _displayed_settings(scenario: Scenario) -> dict[str, Any]:
    return {
        "name": scenario.name,
        "description": scenario.description,
        "seed": scenario.seed,
        "seeds": scenario.traffic.seeds,
        "roi": scenario.roi.model_dump(mode="json"),
        "frame_period_s": scenario.traffic.frame_period_s,
        "vehicles": scenario.traffic.vehicles,
        "gamma": repr(scenario.gamma),
        "gamma_auto": scenario.score.gamma == "auto",
        "weights": scenario.score.weights.in_words,
        "assumed": assumptions(scenario, ()),
        "blindspots": scenario.score.blindspots,
        "sampled_frames": scenario.score.sampled_frames,
        "costs": scenario.costs.model_dump(mode="json"),
        "effects": scenario.effects.model_dump(mode="json"),
    }


def _recorded_stages(folder: Path) -> dict[str, StageRecord]:
    """The stages in ``run.json`` among :data:`STAGES`; InputError if the file is damaged."""
    if not RunFolder(folder).has_record:
        return {}
    recorded = RunRecord.read(folder).stages
    return {name: recorded[name] for name in STAGES if name in recorded}


def _current_what_ifs(work: StageContext, stages: Mapping[str, StageRecord]) -> Entries:
    """The answers of ``egvs what-if`` that belong to the run."""
    if not work.folder.what_if.is_file():
        return {}

    from egvs.results.command_entries import current_entries, what_if_digest

    return current_entries(work.folder.what_if, stages, lambda values: what_if_digest(work.scenario, values["tables"]))


def run(work: StageContext, inputs: StageDependencies) -> Summary:
    """Write ``report.html``.

    Returns
    -------
    dict
        ``best`` and ``worst`` (names of sites, unless all scores are 0), ``kilobytes``.
    """
    del inputs
    out = work.folder.path
    ranking, tpog, stages = Ranking.read(work.folder.scores), read_tpog(work.folder.tpog), _recorded_stages(out)
    work.progress("artefacts read", 1, 3)

    drawn = figures.draw_figures(work, ranking, SiteListing.from_ranking(ranking).choices, tpog)
    work.progress("figures drawn", 2, 3)

    network, backdrop, best = network_file(out), drawn.backdrop, ranking.sites[0]
    plan = _read_plan(work.folder, stages)
    titles = site_titles(ranking.sites, has_relief=has_relief(work.scenario))
    mapped = [pole.best for pole in ranking.poles[:MAPPED_POLES]]
    mounts = [] if plan is None else [sensor.mount for sensor in plan.sensors]
    moved = plan is not None and plan.refinement is not None
    approaches: tuple[ApproachFit, ...] = ()
    if work.scenario.traffic.observed is not None:
        from egvs.report.approach_fits import compare_approaches

        approaches = compare_approaches(work.scenario, work.folder.trajectories, network)
    contents = PageContents(
        work.scenario,
        ranking,
        tpog,
        drawn,
        stages,
        study=study_values(work.folder, stages),
        by_period=PeriodRanking.read(out),
        plan=None if plan is None else _plan_values(plan, work, best.site),
        titles=titles,
        answer_map=_draw_answer(work, plan, ranking, tpog, backdrop),
        what_if=_read_what_ifs(work, stages, best),
        movements=describe_counts(work.scenario, network),
        levels=read_levels(work.folder.levels, ranking.sites[0].site),
        zones=_read_zones(work, best, tpog, drawn, has_plan=plan is not None),
        points=PointsSection.draw(work, mapped, mounts, tpog.grid, backdrop, moved=moved),
        approaches=approaches,
        approach_map=_draw_approach_map(work.scenario, network),
        sections=read_sections(work.folder, work.scenario, stages),
    )
    html = render_page(contents)
    files.write_text(work.folder.report, html)
    work.progress("page written", 3, 3)

    summary: Summary = {"kilobytes": round(len(html.encode("utf-8")) / 1000)}
    if approaches:
        summary["approaches"] = [approach.to_json() for approach in approaches]
    if best.score > 0:
        summary = {"best": best.site, "worst": ranking.last.site, **summary}
    return summary


# Modules of sections are imported for runs that have them.


def _read_plan(folder: RunFolder, stages: Mapping[str, StageRecord]) -> SensorPlan | None:
    """Return the plan in a run folder; None without a plan, or if it belongs to another run."""
    if not folder.placement.is_file():
        return None

    from egvs.results.plans import SensorPlan

    plan = SensorPlan.read(folder)
    return plan if plan is not None and plan.belongs_to(stages) else None


def _plan_values(plan: SensorPlan, work: StageContext, best: str) -> dict[str, Any]:
    from egvs.report.plan_section import plan_headline, plan_values

    headline = ""
    if plan.sensors:
        relief, moved = has_relief(work.scenario), plan.refinement is not None
        titles = site_titles(plan.sensors, has_relief=relief, is_moved=moved)
        sensors = [sensor.sensor for sensor in plan.sensors]
        found = sensor_text.plan_level(work.scenario, sensors, read_levels(work.folder.levels, best))
        headline = plan_headline(plan, titles, found)
    return {**plan_values(plan), "plan_headline": headline}


def _draw_answer(
    work: StageContext, plan: SensorPlan | None, ranking: Ranking, tpog: Tpog, backdrop: maps.Backdrop
) -> str:
    """Return the map of the plan, or of the best site without one, SVG text; empty where no site is best."""
    from egvs.stages.plan_scans import plan_beams

    best = ranking.best[0]
    if not best.score > 0:
        return ""
    poles = [maps.PlannedPole(best.x_m, best.y_m, "1", best.pole, best.site)]
    sites, moved = [Site(best.site, best.pose, best.sensor)], False
    if plan is not None and plan.sensors:
        from egvs.report.plan_section import planned_poles

        poles = planned_poles(plan)
        sites, moved = [sensor.mount for sensor in plan.sensors], plan.refinement is not None
    views_m = [figures.view_outline_m(beams) for _, beams in plan_beams(work, sites, moved=moved)]
    missed = None
    if work.scenario.score.blindspots:
        of_sites = list(read_blindspots(work.folder.blindspots, {site.name for site in sites}))
        together = np.prod([spots.share_missed for spots in of_sites], axis=0)
        missed = replace(of_sites[0], share_missed=together)
    names = ", ".join(pole.label for pole in poles)
    alt = f"The junction from above: {names}, the fields of view, and the share of vehicles that are not found."
    return maps.answer_map(tpog.grid, backdrop, ranking.sites, poles, views_m, missed, alt)


def _read_what_ifs(work: StageContext, stages: Mapping[str, StageRecord], best: RankedSite) -> WhatIfSection | None:
    current = _current_what_ifs(work, stages)
    if not current:
        return None

    from egvs.report.what_if_section import WhatIfSection

    return WhatIfSection.of(current, best)


def _read_zones(
    work: StageContext, best: RankedSite, tpog: Tpog, drawn: Figures, *, has_plan: bool
) -> ZoneSection | None:
    if work.scenario.score.zones is None:
        return None

    from egvs.report.zone_section import ZoneSection

    return ZoneSection.read(work, best, tpog.grid, drawn.backdrop, has_plan=has_plan)


def _draw_approach_map(scenario: Scenario, network: Path | None) -> str:
    if network is None or not busiest_counts(scenario)[1]:
        return ""

    from egvs.report.approach_map import draw_approach_map

    return draw_approach_map(scenario, network)


def _draw_signals(stages: Mapping[str, StageRecord]) -> list[tuple[str, str, str]]:
    plans = traffic_summary(stages).get("signals", ())
    if not plans:
        return []

    from egvs.report.signal_diagram import signal_diagrams

    return signal_diagrams(plans)


def render_page(contents: PageContents) -> str:
    """Return the complete page, HTML text."""
    values = {
        **vars(contents),
        **contents.study,
        "plan_headline": "",
        **(contents.plan or {}),
        **_ranking_values(contents.ranking),
        "found_level": _found_level(contents, contents.scenario.score.detectors),
        **_setting_values(contents),
        **_sensor_values(contents),
        **_cost_values(contents.stages),
        "signals": _draw_signals(contents.stages),
        **_sentences(contents),
        **_warning_values(contents),
    }
    return pages.render(_template_environment(), "report.html.j2", **values)


def prepare() -> None:
    """Load the templates, and the library that fills them."""
    environment = _template_environment()
    for name in environment.list_templates(["j2"]):
        environment.get_template(name)


@cache
def _template_environment() -> Environment:
    from jinja2 import ChoiceLoader, FileSystemLoader, PrefixLoader  # only when a page is written

    environment = pages.page_environment(TEMPLATES)
    assert environment.loader is not None
    folders = {section.name: FileSystemLoader(section.template.parent) for section in report_sections()}
    environment.loader = ChoiceLoader([environment.loader, PrefixLoader(folders)])
    environment.globals |= {
        "choose": (TEMPLATES / "choose.js").read_text(encoding="utf-8"),
        "separable": DISTINCT_PROBABILITY,
        "min_vehicles": MIN_VEHICLES,
    }
    return environment


def _ranking_values(ranking: Ranking) -> dict[str, Any]:
    limit_share = None
    if ranking.by.name == "egvs":
        limit_share = share_of_limit(ranking.sites[0])
    return {
        "listed": LISTED,
        "listing": SiteListing.from_ranking(ranking),
        "by": ranking.by,
        "companion": ranking.companion_score,
        "crowded": maps.is_crowded(ranking.sites),
        "rings": maps.has_stacked_sites(ranking.sites),
        "map_names": maps.describe_names(ranking.sites),
        "limit_share": limit_share,
        "best_name": ranking.sites[0].site,
        "noticed": SCORE_LABELS[NOTICED] if ranking.has_noticed else None,
        "groups_note": GROUPS_NOTE,
    }


def _found_level(contents: PageContents, detectors: Sequence[str]) -> DetectionLevel:
    """Return what is known of the share that these detectors find from the best site."""
    return sensor_text.detection_level(contents.scenario, detectors, contents.ranking.sites[0].sensor, contents.levels)


def _setting_values(contents: PageContents) -> dict[str, Any]:
    scenario = contents.scenario
    effects, gamma = list(scenario.effects.named), scenario.gamma
    modelled = set(effects)
    if "score" in contents.stages and contents.stages["score"].summary.get("losses"):
        modelled.add("range_limit")
    frames = contents.tpog.frames
    if contents.by_period is not None:
        frames = contents.by_period.frames
    return {
        "weights": scenario.score.weights.in_words,
        "assumed": assumptions(scenario, traffic_summary(contents.stages).get("signals", ())),
        "assumes_flows": assumes_flows(scenario),
        "gamma": "∞" if math.isinf(gamma) else f"{gamma:g}",
        "map_credits": read_map_credits(scenario),
        "map_period": busiest_counts(scenario)[0],
        "uncapped": math.isinf(gamma),
        "gamma_auto": scenario.score.gamma == "auto",
        "has_traffic": bool(contents.tpog.counts.any()),
        "frames": frames,
        "duration": formatting.format_duration(frames * scenario.traffic.frame_period_s),
        "effects": effects,
        "unmodelled": [name for name, effect in _UNMODELLED if effect not in modelled],
    }


def _sensor_values(contents: PageContents) -> dict[str, Any]:
    """The best mount of each sensor; None where there is one sensor."""
    sensors = SensorComparison.of_run(
        contents.ranking.sites, contents.scenario.costs, contents.scenario.sites.existing_poles
    )
    names = [site.sensor for site in contents.ranking.sites]
    return {
        "sensors": sensors,
        "range_note": range_note(names, is_modelled=has_losses(contents.scenario, names)),
        "costs_option": costs_option(sensors.sensors) if sensors is not None else "",
        "sensors_explanation": explain_sensor_differences(sensors) if sensors is not None else "",
        "sensors_preference": sensor_text.noticed_preference(sensors) if sensors is not None else "",
        "sensors_evidence": f"{describe_evidence(sensors)} {LOSSES_EVIDENCE}" if sensors is not None else "",
    }


def _cost_values(stages: Mapping[str, StageRecord]) -> dict[str, Any]:
    """Costs and artefacts of the stages; stages without a record are None."""
    seconds = [stage.cost.seconds for stage in stages.values()]
    return {
        "stages": {name: stages.get(name) for name in STAGES},
        "total_s": math.fsum(seconds),
        "longest_s": max(seconds, default=0.0),
        "artefacts": [artefact for stage in stages.values() for artefact in stage.artefacts.items()],
    }


def _warning_values(contents: PageContents) -> dict[str, Any]:
    warnings = collect_warnings(stage.summary for stage in contents.stages.values())
    reliability = describe_reliability(
        contents.ranking, traffic_summary(contents.stages), contents.scenario.score.ranking_detectors
    )
    if contents.ranking.has_noticed:
        sensors = [site.sensor for site in contents.ranking.sites]
        if note := sensor_text.upper_limit_note(contents.scenario, sensors):
            reliability.append(note)
    assumed = assumptions(contents.scenario, traffic_summary(contents.stages).get("signals", ()))
    return {
        "warnings": by_severity(warnings),
        "missing_traffic": describe_missing_traffic(warnings),
        "main_assumptions": main_assumptions(assumed),
        "reliability": reliability,
        "poles_on_road": describe_poles_on_road(contents.ranking.poles[:NAMED_POLES], warnings),
    }


def _sentences(contents: PageContents) -> dict[str, str]:
    """Sentences at the top of the page; an empty one is left out."""
    scenario, ranking, tpog = contents.scenario, contents.ranking, contents.tpog
    has_occlusion = "moving_occlusion" in scenario.effects.named
    setting = egvs_setting(scenario.gamma, tpog.grid.voxel_m, moving_occlusion=has_occlusion)
    found = _found_level(contents, scenario.score.ranking_detectors)
    return {
        "headline": headline(ranking, bool(tpog.counts.any()), found, contents.titles),
        "short_lead": short_lead(ranking),
        "lead": lead(ranking, recorded_frames_hint(scenario, ranking, contents.stages)),
        "entropy_seen_note": entropy_seen_note(ranking),
        "preference": noticed_preference(ranking),
        "disagreement": ranking_disagreement(ranking.sites, setting, detectors=scenario.score.detectors),
    }


STAGE = Stage(
    "report",
    __name__,
    dependencies,
    run,
    reads=(
        RunFolder.trajectories,
        RunFolder.tpog,
        RunFolder.statics,
        RunFolder.scans,
        RunFolder.scores,
        RunFolder.scores_by_period,
        RunFolder.levels,
        RunFolder.blindspots,
        RunFolder.zones,
    ),
    effect_stages=("scan", "score"),
    code=("egvs.stages.scene_inputs",),
    is_view=True,
    prepare=(prepare,),
)
