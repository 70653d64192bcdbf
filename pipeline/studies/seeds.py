"""Independent runs of one setting: do the standard errors, which a single run gives, say how far scores scatter?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.core.errors import EgvsError
from pipeline.scenario.models import Scenario
from pipeline.studies.measuring import SettingListener, SettingRunner, SettingScores
from pipeline.studies.variants import Setting


@dataclass(frozen=True)
class Seeds:
    """What independent runs of the same setting say of the standard errors; each (sites,)."""

    sites: list[str]
    seeds: int
    frames: int
    truth: list[float]
    between: list[float]
    within: list[float]
    bias: list[float]
    expected_bias: list[float]
    covered: float


def between_seeds(runner: SettingRunner, scenario: Scenario, count: int, listener: SettingListener) -> Seeds | None:
    """Independent runs: how far scores scatter, what the standard errors said, and how often the intervals held the
    truth.

    None where fewer than two of them succeed.
    """
    settings: list[Setting] = []
    runs: list[SettingScores] = []
    counts: list[NDArray[np.int64]] = []
    for number in range(1, count + 1):
        setting = Setting(f"seed {scenario.seed + number}", "seed", "seed", (f"seed={scenario.seed + number}",))
        try:
            known = runner.known(setting)
            runs.append(known or runner.run(setting))
        except EgvsError as error:
            listener(setting.name, "skipped", {"why": str(error)})
            continue
        settings.append(setting)
        tpog = runner.tpog(setting)
        counts = [tpog.counts + sum(counts)]
        listener(setting.name, "kept" if known else "done", {"seconds": sum(runner.medians(runs[-1]).values())})
    if len(runs) < 2:
        return None
    merged = Tpog(tpog.grid, tpog.frames * len(runs), counts[0])
    truth = np.array(runner.scores_against(settings[0], merged))
    scores, ses, biases = (np.array([getattr(one, name) for one in runs]) for name in ("scores", "ses", "biases"))
    reach = np.array([[one.quantile] for one in runs]) * ses
    return Seeds(
        sites=runs[0].sites,
        seeds=len(runs),
        frames=tpog.frames,
        truth=truth.tolist(),
        between=scores.std(axis=0, ddof=1).tolist(),
        within=np.sqrt((ses**2).mean(axis=0)).tolist(),
        bias=(scores.mean(axis=0) - truth).tolist(),
        expected_bias=biases.mean(axis=0).tolist(),
        covered=float((np.abs(scores - biases - truth) <= reach).mean()),
    )
