"""The plain scene, the scene with one named effect at a time, and with all of them: what each changes, and costs.

Each is a run like any other, in a folder of its own; stages that an effect does not touch come from the store.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.artefacts.readers import read_scores
from pipeline.core.progress import Progress, silent
from pipeline.runs import workflow
from pipeline.runs.stages import RANKING
from pipeline.scenario.models import Scenario


@dataclass(frozen=True)
class Change:
    """What one effect (or all) does to the scores.

    Attributes
    ----------
    effect
        Its name; "all" for all that the scenario names together; "none" for the plain scene.
    seconds
        Time of all stages but the report; a stage that came from the store counts with what it took to make it.
    sites, scores, ranks
        Of each site, in the order of the sites.
    """

    effect: str
    seconds: float
    sites: tuple[str, ...]
    scores: tuple[float, ...]
    ranks: tuple[int, ...]


def ablation(scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent) -> list[Change]:
    """Run the plain scene, each effect alone, and all together, under ``out / "ablation"``; resumed as any run."""
    every = scenario.effects
    variants = {"none": every.only(), **{name: every.only(name) for name in every.named}}
    if len(every.named) > 1:
        variants["all"] = every
    changes = []
    for name, effects in variants.items():
        folder = out / "ablation" / name
        record = workflow.run(scenario.with_effects(effects), folder, jobs=jobs, progress=progress)
        seconds = sum(record.stages[stage].cost.seconds for stage in RANKING)
        scores = read_scores(folder / "scores.parquet")
        sites, egvs, ranks = (tuple(scores[column].to_pylist()) for column in ("site", "egvs", "rank"))
        changes.append(Change(name, seconds, sites, egvs, ranks))
    return changes
