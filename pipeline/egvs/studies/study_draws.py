"""How the traffic of an accuracy study is divided into units and draws, and what the rows of the study are.

A *unit* is independent traffic: a run with a seed of its own, or one of :data:`RECORDED_PARTS` parts of a recording.
A *draw* is the traffic that a setting would have: a window of some blocks of a unit, a unit, or several consecutive
units in a ring. A setting whose traffic is longer than (k - 2) / 2 of the k units, or longer than one unit where the
score is one over voxels, has no draws, and is priced by a model
(:func:`egvs.studies.decision.assess_by_model`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.results.studies import APPROXIMATES, MEASURES, SCENARIO
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.studies.decision import MIN_UNITS, Draw
from egvs.studies.study_settings import (
    PERIOD_KNOB,
    STEP_KNOB,
    SUBLANES_KNOB,
    PricedSetting,
    Setting,
    SettingValues,
    counted_frames,
    traffic_length_overrides,
)
from egvs.studies.traffic_scores import RunScores, Window, detector_score

RECORDED_PARTS = 5
"""Number of units of a recording that has enough blocks."""

_TRAFFIC_KNOBS = ("", PERIOD_KNOB, STEP_KNOB, SUBLANES_KNOB)
"""Settings that are also tried with parts of the traffic."""


@dataclass(frozen=True)
class TrafficUnits:
    """How runs are divided into units.

    Attributes
    ----------
    blocks
        Number of blocks of a run, in each period.
    parts
        The units of one run: the whole run, or the parts of a recording.
    """

    blocks: int
    parts: tuple[Window, ...]

    @classmethod
    def of(cls, scenario: Scenario) -> TrafficUnits:
        """Return the units of a scenario.

        Raises
        ------
        InputError
            If a recording has too few blocks.
        """
        blocks = scenario.tpog.blocks
        if not scenario.is_recorded:
            return cls(blocks, (Window(0, blocks),))
        if blocks < MIN_UNITS:
            problem = f"the traffic is a finished file, so a study needs at least {MIN_UNITS} blocks, got {blocks}"
            raise InputError(scenario.locate("tpog.blocks"), problem, "Use 10, or another number of blocks.")
        parts = min(RECORDED_PARTS, blocks)
        per_part = blocks // parts
        return cls(blocks, tuple(Window(part * per_part, per_part) for part in range(parts)))

    @property
    def complete(self) -> Window:
        """All blocks of a run."""
        return Window(0, self.blocks)

    @property
    def run_units(self) -> int:
        """Length of a run, in units."""
        return len(self.parts)

    def block_counts(self, values: SettingValues) -> list[int]:
        """Return the numbers of blocks of the parts of a unit that are tried, ascending."""
        if self.run_units > 1:
            return []
        counts = {max(1, round(part * self.blocks)) for part in values.traffic_parts}
        return sorted(count for count in counts if count < self.blocks)

    def windows(self, values: SettingValues) -> list[Window]:
        """Return every window that a draw takes, or that is a unit, or a run."""
        windows = [*self.parts, self.complete]
        for unit in self.parts:
            for count in self.block_counts(values):
                windows += self.windows_in(unit, count)
        return list(dict.fromkeys(windows))

    @staticmethod
    def windows_in(unit: Window, blocks: int) -> list[Window]:
        """Return the windows of some blocks that fill a unit, one after another."""
        starts = range(unit.first, unit.first + unit.blocks - blocks + 1, blocks)
        return [Window(start, blocks) for start in starts]


def priced_settings(
    variant: Setting, scenario: Scenario, units: TrafficUnits, values: SettingValues
) -> Iterator[PricedSetting]:
    """Yield the rows of a study for one variant: with all its traffic, with parts of it, and more.

    Parameters
    ----------
    variant
        Setting whose runs are scored.
    scenario
        The scenario with this setting.
    units
        How its runs are divided.
    values
        Values to try.
    """
    sampled = scenario.score.sampled_frames
    run_units = float(units.run_units)
    yield PricedSetting(variant, variant.name, run_units, 0, sampled)
    if variant.knob in _TRAFFIC_KNOBS:
        for count in units.block_counts(values):
            share = count / units.blocks
            yield from _with_traffic(variant, scenario, share, run_units * share, count)
    if variant.kind != SCENARIO:
        return

    factors = [float(factor) for factor in values.traffic_factors]
    if scenario.is_recorded:
        factors = [1 / units.run_units, 2 / units.run_units]
    for factor in factors:
        yield from _with_traffic(variant, scenario, factor, factor * run_units, 0)
    if scenario.score.rank_by in TARGET_SCORES:
        yield from _with_sampled_frames(scenario, run_units, values)
    if scenario.score.rank_by != DEFAULT_SCORE:
        yield from _by_vehicles_found(variant, scenario, units, values)
    if scenario.score.rank_by == DEFAULT_SCORE and values.detectors and len(scenario.score.detectors) > 1:
        for detector in scenario.score.detectors:
            setting = Setting(f"model of {detector} alone", MEASURES, "detector")
            yield PricedSetting(setting, variant.name, run_units, 0, sampled, detector_score(detector))


def _with_traffic(
    variant: Setting, scenario: Scenario, factor: float, units: float, blocks: int
) -> Iterator[PricedSetting]:
    """Yield a variant with another length of its traffic, unless it has no such length."""
    frames, overrides = traffic_length_overrides(scenario, factor, scenario.traffic.frame_period_s)
    if frames == 0 or not overrides:
        return
    changed = {override.partition("=")[0] for override in overrides}
    unchanged = [override for override in variant.overrides if override.partition("=")[0] not in changed]
    name, knob = f"{frames} frames", "frames"
    if variant.kind != SCENARIO:
        name, knob = f"{name}, {variant.name}", variant.knob
    setting = replace(variant, name=name, kind=APPROXIMATES, knob=knob, overrides=(*unchanged, *overrides))
    yield PricedSetting(setting, variant.name, units, blocks, scenario.score.sampled_frames)


def _by_vehicles_found(
    variant: Setting, scenario: Scenario, units: TrafficUnits, values: SettingValues
) -> Iterator[PricedSetting]:
    """Yield the scenario, and parts of its traffic, ranked by the vehicles that sites are expected to find."""
    override = f"score.rank_by={DEFAULT_SCORE}"
    sampled = scenario.score.sampled_frames
    setting = Setting(f"ranked by {DEFAULT_SCORE}", APPROXIMATES, "score", (override,))
    yield PricedSetting(setting, variant.name, float(units.run_units), 0, sampled, DEFAULT_SCORE)
    for count in units.block_counts(values):
        share = count / units.blocks
        for part in _with_traffic(variant, scenario, share, units.run_units * share, count):
            name = f"{part.setting.name}, {setting.name}"
            overrides = (*part.setting.overrides, override)
            ranked = replace(part.setting, name=name, knob="score", overrides=overrides)
            yield replace(part, setting=ranked, score=DEFAULT_SCORE)


def _with_sampled_frames(scenario: Scenario, run_units: float, values: SettingValues) -> Iterator[PricedSetting]:
    """Yield the scenario with more or fewer frames for scores over vehicles."""
    available = counted_frames(scenario)
    for factor in values.sampled_factors:
        sampled = min(available, max(1, round(factor * scenario.score.sampled_frames)))
        if sampled == min(available, scenario.score.sampled_frames):
            continue
        setting = Setting(
            f"{sampled} frames for detection", APPROXIMATES, "sampled frames", (f"score.sampled_frames={sampled}",)
        )
        yield PricedSetting(setting, SCENARIO, run_units, 0, sampled)


def unit_scores(runs: Sequence[RunScores], units: TrafficUnits, priced: PricedSetting) -> FloatArray:
    """Return the score that chooses of all mounts, from all traffic of each unit, (k, n) float64.

    Parameters
    ----------
    runs
        Runs of the variant.
    units
        How they are divided.
    priced
        The setting.
    """
    frames = max(1, round(priced.sampled_frames / max(1.0, priced.units)))
    return np.array([_window_score(run, part, priced, frames) for run in runs for part in units.parts])


def draws(runs: Sequence[RunScores], units: TrafficUnits, priced: PricedSetting) -> list[Draw]:
    """Return the draws of a setting; none if only the model can price it.

    Parameters
    ----------
    runs, units, priced
        As in :func:`unit_scores`.
    """
    parts = [(run, part) for run in runs for part in units.parts]
    count = len(parts)
    if priced.blocks:
        result = []
        for number, (run, unit) in enumerate(parts):
            for window in units.windows_in(unit, priced.blocks):
                result.append(Draw((number,), _window_score(run, window, priced, priced.sampled_frames)))
        return result
    length = round(priced.units)
    if length == 1:
        return [Draw((number,), row) for number, row in enumerate(unit_scores(runs, units, priced))]
    name = priced.score or runs[0].rank_by
    if length > (count - 2) // 2 or name not in runs[0].sums:
        return []
    result = []
    frames = max(1, priced.sampled_frames // length)
    for first in range(count):
        ring = sorted((first + step) % count for step in range(length))
        sums = [parts[number][0].sum_over(name, parts[number][1], frames) for number in ring]
        weight = sum(part_weight for _, part_weight in sums)
        total = sum((part_sum for part_sum, _ in sums), np.zeros(len(runs[0].mounts)))
        result.append(Draw(tuple(ring), total / weight if weight > 0.0 else total))
    return result


def _window_score(run: RunScores, window: Window, priced: PricedSetting, frames: int) -> FloatArray:
    if priced.score:
        return run.score(priced.score, window, frames)
    return run.ranking_score(window, frames)
