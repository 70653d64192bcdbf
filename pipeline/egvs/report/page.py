"""The report stage: one page that shows a reader who has not read the paper what came of a run.

Steps: read the scores, the TPOG and ``run.json``; draw (:mod:`egvs.report.figures`); fill the template.
``report.html`` is one file that fetches nothing.

It is a function of the artefacts and of what ``run.json`` holds of the earlier stages, their costs included: no clock,
no path, no machine. A second run with the same costs writes the same bytes. Stages that ran one by one in a notebook
leave no ``run.json``: the page then says that it does not know.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egvs._version import __version__
from egvs.artefacts.readers import DISTINCT_PROBABILITY, MIN_VEHICLES, PeriodRanking
from egvs.artefacts.run_folder import ACCURACY_FILES, PLACEMENT_FILES, VALIDATION_FILES, RunFolder
from egvs.artefacts.run_record import RunRecord, StageRecord
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files
from egvs.core.errors import WARNINGS_KEY, collect_warnings
from egvs.report import figures, formatting, maps
from egvs.report.basemap import network_file
from egvs.report.colours import STYLE_SHEET
from egvs.report.figures import Figures
from egvs.report.ranking import RankedSite, Ranking, entropy_seen_note, headline, lead, share_of_limit
from egvs.report.sections import PlacementSummary, StudySummary, ValidationSummary, egvs_setting, ranking_disagreement
from egvs.scenario.model import Scenario
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.scene_inputs import scan_dependencies

STAGES = ("check", "traffic", "statics", "tpog", "scan", "score")
"""Those whose costs and artefacts the page shows, in its order."""

LISTED, FIRST, LAST = 40, 30, 5
"""More than ``LISTED`` sites are shown as the first and the last of them."""

CHOOSABLE = 200
"""Of more sites, the first ones and the ``LAST`` ones can be chosen to be drawn: each takes some 20 kB."""

TEMPLATES = Path(__file__).parent / "templates"

_UNMODELLED = (
    ("what vehicles hide from the EGVS", "moving_occlusion"),
    ("rain", "rain"),
    ("fog", "fog"),
    ("the weakening of a beam with distance", "range_limit"),
    ("leaves that let some light through", "foliage"),
    ("people on foot and on bicycles", "pedestrians_bicycles"),
    ("dirt and glare", ""),
)
"""What no plain scene models, and the effect that does."""


def dependencies(work: StageContext) -> StageDependencies:
    """The artefacts by hash, the summaries and costs of the earlier stages, and the settings that are shown."""
    scenario, stages = work.scenario, _recorded_stages(work.folder.path)
    read = [RunFolder.trajectories.name, RunFolder.tpog.name, RunFolder.statics.name, RunFolder.scores.name]
    settings: dict[str, Any] = {"shown": _displayed_settings(scenario), "keep": scenario.scan.keep}
    hashes: dict[str, str] = {}
    if scenario.scan.keep:
        read.append(RunFolder.scans.name)
    else:
        cast = scan_dependencies(work)
        settings["scan"], hashes = cast.settings, dict(cast.files)
    beside = (
        RunFolder.scores_by_period.name,
        RunFolder.blindspots.name,
        *ACCURACY_FILES,
        *VALIDATION_FILES,
        *PLACEMENT_FILES,
    )
    hashes |= work.digests(*(name for name in (*read, *beside) if work.path(name).is_file()))
    if (roads := network_file(work.folder.path)) is not None:
        hashes |= work.digests(roads.relative_to(work.folder.path).as_posix())
    # what a stage sums up is the same in every run, but for the seconds of SUMO, which are not shown
    summaries = {
        name: {key: value for key, value in stages[name].summary.items() if key != "sumo_seconds"}
        for name in ("traffic", "statics")
        if name in stages
    }
    costs = {name: [stage.cost.seconds, stage.cost.peak_mb] for name, stage in stages.items()}
    warnings = [stage.summary.get(WARNINGS_KEY, []) for stage in stages.values()]
    return StageDependencies(settings, hashes, {"costs": costs, "summaries": summaries, "warnings": warnings})


def _listed_sites(ranking: Ranking) -> tuple[tuple[RankedSite, ...], tuple[RankedSite, ...]]:
    """The first sites and the last ones that the page shows; all are first where they are few."""
    if len(ranking.sites) <= LISTED:
        return ranking.sites, ()
    return ranking.sites[:FIRST], ranking.sites[-LAST:]


def _choosable(ranking: Ranking) -> tuple[RankedSite, ...]:
    """The sites that a reader may choose to see."""
    if len(ranking.sites) <= CHOOSABLE:
        return ranking.sites
    return ranking.sites[: CHOOSABLE - LAST] + ranking.sites[-LAST:]


def _displayed_settings(scenario: Scenario) -> dict[str, Any]:
    return {
        "name": scenario.name,
        "description": scenario.description,
        "seed": scenario.seed,
        "roi": scenario.roi.model_dump(mode="json"),
        "frame_period_s": scenario.traffic.frame_period_s,
        "vehicles": scenario.traffic.vehicles,
        "gamma": repr(scenario.gamma),
        "gamma_auto": scenario.score.gamma == "auto",
        "weights": scenario.score.weights.in_words,
        "blindspots": scenario.score.blindspots,
        "effects": scenario.effects.model_dump(mode="json"),
    }


def _recorded_stages(folder: Path) -> dict[str, StageRecord]:
    """Those of ``STAGES`` that ``run.json`` knows; InputError where it is damaged."""
    known = RunRecord.read(folder).stages if RunFolder(folder).run_record.is_file() else {}
    return {name: known[name] for name in STAGES if name in known}


def run(work: StageContext, inputs: StageDependencies) -> Summary:
    """Write ``report.html``.

    Returns
    -------
    dict
        ``best`` and ``worst`` (names of sites), ``kilobytes``.
    """
    del inputs
    out = work.folder.path
    ranking, tpog, stages = Ranking.read(RunFolder(out).scores), read_tpog(RunFolder(out).tpog), _recorded_stages(out)
    work.progress("artefacts read", 1, 3)
    drawn = figures.draw_figures(work, ranking, _choosable(ranking), tpog)
    work.progress("figures drawn", 2, 3)
    study, detected = StudySummary.read(out, stages), ValidationSummary.read(out, stages)
    plan = PlacementSummary.read(out, stages, ranking.sites, tpog, drawn.backdrop)
    html = render_page(work.scenario, ranking, tpog, drawn, stages, study, PeriodRanking.read(out), detected, plan)
    files.write_text(work.folder.report, html)
    work.progress("page written", 3, 3)
    kilobytes = round(len(html.encode("utf-8")) / 1000)
    if not ranking.sites[0].score > 0:  # which is no ranking
        return {"kilobytes": kilobytes}
    return {"best": ranking.sites[0].site, "worst": ranking.last.site, "kilobytes": kilobytes}


def render_page(
    scenario: Scenario,
    ranking: Ranking,
    tpog: Tpog,
    drawn: Figures,
    stages: Mapping[str, StageRecord],
    study: StudySummary | None,
    by_period: PeriodRanking | None = None,
    detected: ValidationSummary | None = None,
    plan: PlacementSummary | None = None,
) -> str:
    """The whole page, HTML text; ``stages`` are those that are known, in the order of ``STAGES``."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    loader = FileSystemLoader(TEMPLATES)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "svg": Markup,
        "share": formatting.format_percent,
        "whole": formatting.format_count,
        "plain": formatting.format_number,
        "degrees": formatting.format_degrees,
    }
    sites, effects, gamma = ranking.sites, list(scenario.effects.named), scenario.gamma
    (first, last), has_traffic = _listed_sites(ranking), bool(tpog.counts.any())
    seconds = [stage.cost.seconds for stage in stages.values()]
    frames = tpog.frames if by_period is None else by_period.frames
    return environment.get_template("report.html.j2").render(
        scenario=scenario,
        ranking=ranking,
        tpog=tpog,
        figures=drawn,
        stages={name: stages.get(name) for name in STAGES},
        total_s=math.fsum(seconds),
        longest_s=max(seconds, default=0.0),
        artefacts=[artefact for stage in stages.values() for artefact in stage.artefacts.items()],
        study=study,
        detected=detected,
        plan=plan,
        first=first,
        choices=_choosable(ranking),
        out_of_choice=len(sites) - len(_choosable(ranking)),
        listed=LISTED,
        last=last,
        hidden=len(sites) - len(first) - len(last),
        headline=headline(ranking, has_traffic),
        lead=lead(ranking),
        beside_entropy_seen=entropy_seen_note(ranking),
        disagreement=ranking_disagreement(
            sites, egvs_setting(gamma, tpog.grid.voxel_m, moving_occlusion="moving_occlusion" in effects)
        ),
        limit_share=share_of_limit(sites[0]) if ranking.by.name == "egvs" else None,
        separable=DISTINCT_PROBABILITY,
        has_traffic=has_traffic,
        crowded=maps.is_crowded(sites),
        rings=maps.has_stacked_sites(sites),
        by=ranking.by,
        weights=scenario.score.weights.in_words,
        beside=ranking.companion_score,
        style=Markup(STYLE_SHEET),
        choose=Markup((TEMPLATES / "choose.js").read_text(encoding="utf-8")),
        gamma="∞" if math.isinf(gamma) else f"{gamma:g}",
        uncapped=math.isinf(gamma),
        gamma_auto=scenario.score.gamma == "auto",
        by_period=by_period,
        frames=frames,
        watched=formatting.format_duration(frames * scenario.traffic.frame_period_s),
        effects=effects,
        fewest_vehicles=MIN_VEHICLES,
        left_out=[what for what, effect in _UNMODELLED if effect not in effects],
        warnings=collect_warnings(stage.summary for stage in stages.values()),
        version=__version__,
    )


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
        RunFolder.blindspots,
    ),
    effect_stages=("scan", "score"),
)
