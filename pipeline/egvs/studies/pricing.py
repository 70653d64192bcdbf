"""Prices of settings: what each chooses, what that loses, and what it costs; the rows of an accuracy study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.results.studies import MEASURES, SCENARIO, SettingResult
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.statistics.ranks import rank_agreement, relative_errors
from egvs.studies import decision, study_draws, study_settings
from egvs.studies.decision import Draw, Reference
from egvs.studies.recommendation import NeededTraffic
from egvs.studies.study_runs import StudyRuns, simulation_steps
from egvs.studies.study_settings import SCENARIO_AS_IS, PricedSetting, Setting, SettingValues


@dataclass(frozen=True)
class BestPole:
    """The pole that all traffic together prefers.

    Attributes
    ----------
    name, mount
        Its name, and that of its best mount.
    found
        Share of the vehicles that its best mount is expected to find, 0 to 1.
    probability
        Probability that it is the best one.
    """

    name: str
    mount: str
    found: float
    probability: float


class Pricing:
    """Prices the settings of a study.

    Parameters
    ----------
    runs
        The finished runs.
    values
        Values that settings try.
    """

    def __init__(self, runs: StudyRuns, values: SettingValues) -> None:
        self._runs, self._values = runs, values
        scenario_runs = runs.runs[SCENARIO]
        parts = [(run, part) for run in scenario_runs for part in runs.units.parts]
        poles = scenario_runs[0].poles
        self._poles = tuple(dict.fromkeys(poles))
        number = {name: index for index, name in enumerate(self._poles)}
        self.reference = Reference(
            np.array([run.score(DEFAULT_SCORE, part) for run, part in parts]),
            np.array([number[name] for name in poles]),
        )
        self._plain = PricedSetting(
            SCENARIO_AS_IS, SCENARIO, float(runs.units.run_units), 0, runs.scenario.score.sampled_frames
        )
        self._base_scores = self._unit_scores("")

    def _unit_scores(self, score: str) -> FloatArray:
        """Return a score of all mounts (the one that ranks if empty) from each unit of the scenario, (k, n) float64."""
        unit = PricedSetting(SCENARIO_AS_IS, SCENARIO, 1.0, 0, self._plain.sampled_frames, score)
        return study_draws.unit_scores(self._runs.runs[SCENARIO], self._runs.units, unit)

    @property
    def best_pole(self) -> BestPole:
        """The pole that all traffic together prefers."""
        found = self.reference.found.mean(axis=0)
        best = int(found.argmax())
        pole = int(self.reference.poles[best])
        chances = decision.best_pole_chances(self.reference, range(self.reference.units))
        mount = self._runs.runs[SCENARIO][0].mounts[best]
        return BestPole(self._poles[pole], mount, float(found[best]), round(float(chances[pole]), 4))

    @property
    def is_all_zero(self) -> bool:
        """Whether every score that ranks is 0."""
        return not self._base_scores.any()

    def rows(self, variants: Sequence[Setting]) -> list[SettingResult]:
        """Return a row for each setting that was run, with all lengths of its traffic.

        Parameters
        ----------
        variants
            Settings that were run.
        """
        rows = []
        for variant in variants:
            scenario = self._runs.runner.scenario(variant)
            for priced in study_draws.priced_settings(variant, scenario, self._runs.units, self._values):
                row = self._price(variant, priced)
                if row is not None:
                    rows.append(row)
        return rows

    def needed_traffic(self, row: SettingResult, tolerance_points: float) -> NeededTraffic:
        """Return the traffic with which the scenario's setting would reach a tolerance, by the model.

        Parameters
        ----------
        row
            The row of the scenario.
        tolerance_points
            Percentage points of vehicles found.
        """
        length_units = decision.length_needed(self._base_scores, self.reference, tolerance_points)
        factor = length_units / self._runs.units.run_units
        seconds = {"traffic": row.traffic_s, "tpog": row.tpog_s}
        longer_s = factor * sum(seconds.values())
        return NeededTraffic(factor * row.frames, longer_s + row.statics_s + row.scan_s + row.score_s)

    def _price(self, variant: Setting, priced: PricedSetting) -> SettingResult | None:
        """Return the row of one setting; None if its frames were not scored, or it is not a valid scenario."""
        name = priced.setting.name
        runs = self._runs.runs.get(priced.variant, self._runs.runs[SCENARIO])
        if priced.sampled_frames > self._runs.reference_frames:
            self._runs.skipped[name] = "with so many sites, no more frames for detection were scored"
            return None
        try:
            scenario = self._runs.runner.scenario(priced.setting)
        except InputError as error:
            self._runs.skipped[name] = str(error)
            return None
        scores = study_draws.unit_scores(runs, self._runs.units, priced)
        drawn = study_draws.draws(runs, self._runs.units, priced)
        if drawn:
            quality = decision.assess_choices(drawn, scores, self.reference, priced.units)
            choices = np.mean([decision.choose(draw.scores) for draw in drawn], axis=0)
        else:
            quality = decision.assess_by_model(scores, self.reference, priced.units)
            choices = decision.choose(scores.mean(axis=0))
        by_pole = np.bincount(self.reference.poles, choices)
        score_error, tau = self._score_errors(priced, scores, drawn)
        seconds, measured = self._stage_seconds(variant, priced, scenario)
        return SettingResult(
            setting=priced.setting.name,
            kind=priced.setting.kind,
            knob=priced.setting.knob,
            overrides=priced.setting.to_options(),
            seconds=sum(seconds.values()),
            statics_s=seconds["statics"],
            scan_s=seconds["scan"],
            traffic_s=seconds["traffic"],
            tpog_s=seconds["tpog"],
            score_s=seconds["score"],
            measured=measured,
            frames=study_settings.counted_frames(scenario),
            sampled_frames=min(priced.sampled_frames, study_settings.counted_frames(scenario)),
            draws=quality.draws,
            probability=quality.probability,
            probability_se=quality.probability_se,
            loss_points=quality.loss_points,
            loss_se_points=quality.loss_se_points,
            error=score_error,
            tau=tau,
            best=self._poles[int(by_pole.argmax())],
            best_share=round(float(by_pole.max()), 4),
        )

    def _score_errors(self, priced: PricedSetting, scores: FloatArray, drawn: Sequence[Draw]) -> tuple[float, float]:
        """Return the relative error of the score, and the mean of Kendall's tau.

        An approximation is compared with the scenario's scores from the units outside each draw (of the same score, if
        another one than the scenario's ranks); another quantity with the scenario's scores of the same unit.
        """
        base = self._base_scores
        if priced.setting.knob == "score":
            base = self._unit_scores(priced.score)
        compared = drawn or [Draw((unit,), row) for unit, row in enumerate(scores)]
        # scores of thinned beams; a finite gamma is divided by the weight already
        weight = priced.setting.weight if math.isinf(self._runs.scenario.gamma) else 1.0
        errors, taus = [], []
        for draw in compared:
            if priced.setting.kind == MEASURES:
                expected = base[list(draw.units)].mean(axis=0)
            else:
                expected = np.delete(base, list(draw.units), axis=0).mean(axis=0)
            errors.append(relative_errors(weight * draw.scores, expected).max(initial=0.0))
            taus.append(rank_agreement(draw.scores, expected, "tau"))
        error = float(np.sqrt(np.mean(np.square(errors))))
        if not drawn and priced.setting.kind != MEASURES:
            error /= math.sqrt(priced.units)
        return round(error, 6), round(float(np.mean(taus)), 4)

    def _stage_seconds(
        self, variant: Setting, priced: PricedSetting, scenario: Scenario
    ) -> tuple[Mapping[str, float], bool]:
        """Return the processor seconds of each stage, and whether they were measured or follow from the frames."""
        variant_s = self._runs.seconds[variant.name]
        if priced.setting.overrides == variant.overrides:
            return variant_s, True
        if priced.setting.knob == "sampled frames":
            factor = priced.sampled_frames / self._plain.sampled_frames
            return self._runs.sampled_seconds(priced.setting, factor)
        original = self._runs.runner.scenario(variant)
        frames = study_settings.counted_frames(scenario) / study_settings.counted_frames(original)
        seconds = dict(variant_s)
        seconds["tpog"] *= frames
        if scenario.is_recorded:
            seconds["traffic"] *= frames
        else:
            seconds["traffic"] *= simulation_steps(scenario) / simulation_steps(original)
        return seconds, False
