"""The report stage: one page that shows a reader who has not read the paper what came of a run.

Steps: read the scores, the TPOG and ``run.json``; draw (:mod:`pipeline.report.figures`); fill the template.
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

from pipeline.artefacts.blindspots import BLINDSPOTS, FEWEST_VEHICLES
from pipeline.artefacts.period_ranking import PERIOD_SCORES, PeriodRanking
from pipeline.artefacts.readers import SEPARABLE, Tpog, read_tpog
from pipeline.artefacts.run_record import RECORD, RunRecord, StageRecord
from pipeline.core import files
from pipeline.core.findings import WARNINGS, warnings_of
from pipeline.core.version import __version__
from pipeline.report import figures, wording
from pipeline.report.detected import VALIDATION, ValidationSummary
from pipeline.report.drawing import maps
from pipeline.report.drawing.colours import STYLE_SHEET
from pipeline.report.drawing.roads import network_file
from pipeline.report.evidence import disagreement, setting_of
from pipeline.report.figures import Figures
from pipeline.report.placement import PLACEMENT, PlacementSummary
from pipeline.report.ranking import Ranking, ScoredSite
from pipeline.report.study import ACCURACY, StudySummary
from pipeline.scenario.models import Scenario
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.stages.shared.scene import scan_inputs

NAME = "report"
ARTEFACTS = ("report.html",)

STAGES = ("check", "traffic", "statics", "tpog", "scan", "score")
"""Those whose costs and artefacts the page shows, in its order."""

LISTED, FIRST, LAST = 40, 30, 5
"""More than ``LISTED`` sites are shown as the first and the last of them."""

CHOOSABLE = 200
"""Of more sites, the first ones and the ``LAST`` ones can be chosen to be drawn: each takes some 20 kB."""

TEMPLATES = Path(__file__).parent / "templates"

_LEFT_OUT = (
    ("what vehicles hide from the EGVS", "moving_occlusion"),
    ("rain", "rain"),
    ("fog", "fog"),
    ("the weakening of a beam with distance", "range_limit"),
    ("leaves that let some light through", "foliage"),
    ("people on foot and on bicycles", "pedestrians_bicycles"),
    ("dirt and glare", ""),
)
"""What no plain scene models, and the effect that does."""


def inputs(work: Workspace) -> StageInputs:
    """The artefacts by hash, the summaries and costs of the earlier stages, and the settings that are shown."""
    scenario, stages = work.scenario, _recorded(work.folder)
    read = ["trajectories.parquet", "tpog.parquet", "statics.ply", "scores.parquet"]
    settings: dict[str, Any] = {"shown": _shown(scenario), "keep": scenario.scan.keep}
    hashes: dict[str, str] = {}
    if scenario.scan.keep:
        read.append("scans.parquet")
    else:
        cast = scan_inputs(work)
        settings["scan"], hashes = cast.settings, dict(cast.files)
    beside = (PERIOD_SCORES, BLINDSPOTS, *ACCURACY, *VALIDATION, *PLACEMENT)
    hashes |= work.digests(*(name for name in (*read, *beside) if work.path(name).is_file()))
    if (roads := network_file(work.folder)) is not None:
        hashes |= work.digests(roads.relative_to(work.folder).as_posix())
    # what a stage sums up is the same in every run, but for the seconds of SUMO, which are not shown
    summaries = {
        name: {key: value for key, value in stages[name].summary.items() if key != "sumo_seconds"}
        for name in ("traffic", "statics")
        if name in stages
    }
    costs = {name: [stage.cost.seconds, stage.cost.peak_mb] for name, stage in stages.items()}
    warnings = [stage.summary.get(WARNINGS, []) for stage in stages.values()]
    return StageInputs(settings, hashes, {"costs": costs, "summaries": summaries, "warnings": warnings})


def _listed(ranking: Ranking) -> tuple[tuple[ScoredSite, ...], tuple[ScoredSite, ...]]:
    """The first sites and the last ones that the page shows; all are first where they are few."""
    if len(ranking.sites) <= LISTED:
        return ranking.sites, ()
    return ranking.sites[:FIRST], ranking.sites[-LAST:]


def _choosable(ranking: Ranking) -> tuple[ScoredSite, ...]:
    """The sites that a reader may choose to see."""
    if len(ranking.sites) <= CHOOSABLE:
        return ranking.sites
    return ranking.sites[: CHOOSABLE - LAST] + ranking.sites[-LAST:]


def _shown(scenario: Scenario) -> dict[str, Any]:
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


def _recorded(folder: Path) -> dict[str, StageRecord]:
    """Those of ``STAGES`` that ``run.json`` knows; InputError where it is damaged."""
    known = RunRecord.read(folder).stages if (folder / RECORD).is_file() else {}
    return {name: known[name] for name in STAGES if name in known}


def run(work: Workspace, inputs: StageInputs) -> Summary:
    """Write ``report.html``.

    Returns
    -------
    dict
        ``best`` and ``worst`` (names of sites), ``kilobytes``.
    """
    del inputs
    out = work.folder
    ranking, tpog, stages = Ranking.read(out / "scores.parquet"), read_tpog(out / "tpog.parquet"), _recorded(out)
    work.progress("artefacts read", 1, 3)
    drawn = figures.draw(work, ranking, _choosable(ranking), tpog)
    work.progress("figures drawn", 2, 3)
    study, detected = StudySummary.read(out, stages), ValidationSummary.read(out, stages)
    plan = PlacementSummary.read(out, stages, ranking.sites, tpog, drawn.backdrop)
    html = page(work.scenario, ranking, tpog, drawn, stages, study, PeriodRanking.read(out), detected, plan)
    files.write_text(work.path(ARTEFACTS[0]), html)
    work.progress("page written", 3, 3)
    kilobytes = round(len(html.encode("utf-8")) / 1000)
    if not ranking.sites[0].score > 0:  # which is no ranking
        return {"kilobytes": kilobytes}
    return {"best": ranking.sites[0].site, "worst": ranking.last.site, "kilobytes": kilobytes}


def page(
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
        "share": wording.share,
        "whole": wording.whole,
        "plain": wording.plain,
        "degrees": wording.degrees,
    }
    sites, effects, gamma = ranking.sites, list(scenario.effects.named), scenario.gamma
    (first, last), has_traffic = _listed(ranking), bool(tpog.counts.any())
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
        headline=wording.headline(ranking, has_traffic),
        lead=wording.lead(ranking),
        beside_entropy_seen=wording.beside_entropy_seen(ranking),
        disagreement=disagreement(
            sites, setting_of(gamma, tpog.grid.voxel_m, moving_occlusion="moving_occlusion" in effects)
        ),
        limit_share=wording.share_of_limit(sites[0]) if ranking.by.name == "egvs" else None,
        separable=SEPARABLE,
        has_traffic=has_traffic,
        crowded=maps.is_crowded(sites),
        rings=maps.has_shared_places(sites),
        by=ranking.by,
        weights=scenario.score.weights.in_words,
        beside=ranking.beside,
        style=Markup(STYLE_SHEET),
        choose=Markup((TEMPLATES / "choose.js").read_text(encoding="utf-8")),
        gamma="∞" if math.isinf(gamma) else f"{gamma:g}",
        uncapped=math.isinf(gamma),
        gamma_auto=scenario.score.gamma == "auto",
        by_period=by_period,
        frames=frames,
        watched=wording.duration(frames * scenario.traffic.frame_period_s),
        effects=effects,
        fewest_vehicles=FEWEST_VEHICLES,
        left_out=[what for what, effect in _LEFT_OUT if effect not in effects],
        warnings=warnings_of(stage.summary for stage in stages.values()),
        version=__version__,
    )
