"""The runs of an accuracy study: which seeds and settings are simulated within the budget, and what their stages cost.

Every stage is measured after a warm-up that compiles what it needs, in processor seconds: wall-clock seconds depend on
what else the machine does. Scores of finished runs are saved, so an interrupted study continues where it stopped.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from time import perf_counter
from typing import Any

from egvs.core.errors import EgvsError, InputError, RunError
from egvs.effects import registry
from egvs.results.studies import MEASURES, SCENARIO
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.sensors import sites
from egvs.studies import study_settings, traffic_options
from egvs.studies.decision import MIN_UNITS
from egvs.studies.measurement import SettingListener, SettingRunner
from egvs.studies.study_draws import TrafficUnits
from egvs.studies.study_settings import PERIOD_KNOB, SCENARIO_AS_IS, Setting, SettingValues
from egvs.studies.traffic_scores import RunScores, score_run

BEYOND_BUDGET = "beyond the budget"
"""Why a setting was not run."""

MAX_SEEDS = 8
"""Number of seeds of the scenario that a study simulates while the budget lasts."""

OVERSAMPLING = 3
"""How many times as many frames as the scenario's the reference uses. An odd multiple contains the same frames."""

MAX_REFERENCE_SCANS = 30_000
"""The reference is not oversampled if mounts times frames are more than this."""

_MARGIN = 1.25
"""Factor for expected times, so that a study ends within its budget."""

_MAX_FAILED_SEEDS = 4
"""So many seeds may fail, for example because a vehicle stands without end."""


class StudyRuns:
    """Runs of the scenario with several seeds, and of settings.

    Parameters
    ----------
    runner
        Runs stages, and saves results.
    values
        Values that settings try.
    budget_s
        Settings that would not end within this time are not started.
    listener
        Called after each seed and setting.

    Attributes
    ----------
    scenario, units
        The scenario, and how its runs are divided.
    runs
        Variant -> scores of its runs; variants that cannot change scores have none of their own.
    seconds
        Variant -> processor seconds of each stage.
    seeds
        Seeds of the scenario's runs.
    stage_keys
        Key of each stage of the scenario.
    skipped
        Why settings were not run, by name.
    """

    def __init__(
        self, runner: SettingRunner, values: SettingValues, budget_s: float, listener: SettingListener
    ) -> None:
        self.runner = runner
        self.scenario = runner.scenario(SCENARIO_AS_IS)
        self.units = TrafficUnits.of(self.scenario)
        self.runs: dict[str, list[RunScores]] = {SCENARIO: []}
        self.seconds: dict[str, dict[str, float]] = {}
        self.seeds: list[int] = []
        self.skipped: dict[str, str] = {}
        self._values, self._budget_s, self._listener = values, budget_s, listener
        self._n_mounts = len(sites.candidate_sites(self.scenario))
        self.stage_keys: dict[str, str] = {}
        self._run_wall_s = 0.0
        self._start = perf_counter()

    @property
    def left_s(self) -> float:
        """Rest of the budget."""
        return self._budget_s - (perf_counter() - self._start)

    def run(self, seeds: int | None) -> list[Setting]:
        """Run the scenario and all settings that the budget allows, and return the settings.

        Parameters
        ----------
        seeds
            Number of seeds of the scenario; None for as many as the budget allows.
        """
        variants = self._valid_variants()
        self._warm_up(variants)
        self.seconds[SCENARIO] = self.runner.measure_stages(SCENARIO_AS_IS)
        self.stage_keys = self.runner.run_stages(SCENARIO_AS_IS)
        self._run_scenario(seeds)
        for variant in self._by_cost(variants):
            self._run_variant(variant)
        if seeds is None:
            self._add_seeds(MAX_SEEDS, keep_s=0.0)
        return [variant for variant in variants if variant.name in self.seconds]

    def sampled_seconds(self, setting: Setting, factor: float) -> tuple[dict[str, float], bool]:
        """Return the processor seconds of each stage with other frames for scores over vehicles.

        They are measured if the budget lasts; else the score stage is taken as proportional to the frames. The second
        value is whether they were measured.

        Parameters
        ----------
        setting
            The setting.
        factor
            How many times as many frames as the scenario.
        """
        if 2.0 * factor * self.runner.median_seconds(self.stage_keys)["score"] < self.left_s:
            return self.runner.measure_stages(setting), True
        seconds = dict(self.seconds[SCENARIO])
        seconds["score"] *= factor
        return seconds, False

    def _valid_variants(self) -> list[Setting]:
        """Return the settings whose overrides give a valid scenario; skip the others."""
        values = self._values
        self.skipped |= traffic_options.options_without_effect(self.scenario, values)
        variants = []
        for variant in (
            *study_settings.list_variants(self.scenario, values),
            *traffic_options.traffic_option_settings(self.scenario, values),
        ):
            try:
                self.runner.scenario(variant)
            except InputError as error:
                self._skip(variant.name, str(error))
            else:
                variants.append(variant)
        return variants

    def _skip(self, name: str, reason: str) -> None:
        self.skipped[name] = reason
        self._listener(name, "skipped", {"why": reason, "beyond": reason == BEYOND_BUDGET})

    def _warm_up(self, variants: Sequence[Setting]) -> None:
        """Compile everything that the settings need, with short traffic and one site, and with each added effect."""
        if self._saved(SCENARIO_AS_IS, self.scenario.seed) is not None:
            return
        _, shorter = study_settings.traffic_length_overrides(
            self.scenario, 1 / self.units.blocks, self.scenario.traffic.frame_period_s
        )
        trials = [Setting("warm-up", MEASURES, "", shorter)]
        for variant in variants:
            if variant.name.startswith(study_settings.WITH_PREFIX):
                trials.append(replace(trials[0], overrides=(*shorter, *variant.overrides)))
        for trial in trials:
            with suppress(EgvsError):  # reported when the setting itself runs
                self.runner.warm_up(trial)

    def _run_scenario(self, seeds: int | None) -> None:
        """Score the seeds that a study needs, or the recording."""
        if self.scenario.is_recorded:
            self._add_run(self.scenario.seed)
            return
        self._add_seeds(seeds or MIN_UNITS, keep_s=-math.inf)
        if seeds is None:
            self._add_seeds(MAX_SEEDS - 2, keep_s=0.5 * self._budget_s)

    def _add_seeds(self, count: int, *, keep_s: float) -> None:
        """Score further seeds of the scenario, up to ``count``, while that leaves ``keep_s`` of the budget."""
        if self.scenario.is_recorded:
            return
        seed = self.seeds[-1] + 1 if self.seeds else self.scenario.seed
        failed = ""
        last = self.scenario.seed + count + _MAX_FAILED_SEEDS
        while len(self.seeds) < count and seed < last and self.left_s - _MARGIN * self._run_wall_s > keep_s:
            try:
                self._add_run(seed)
            except RunError as error:
                if seed == self.scenario.seed:
                    raise
                failed = str(error)
                self._skip(f"seed {seed}", failed)
            seed += 1
        if len(self.seeds) < MIN_UNITS:
            raise RunError(f"{len(self.seeds)} seeds can be simulated, a study needs {MIN_UNITS}. Last error: {failed}")

    def _add_run(self, seed: int) -> None:
        started = perf_counter()
        self.runs[SCENARIO].append(self._score_run(SCENARIO_AS_IS, seed))
        self.seeds.append(seed)
        wall_s = perf_counter() - started
        self._run_wall_s = max(self._run_wall_s, wall_s)
        self._listener(f"seed {seed}", "done", {"seconds": wall_s})

    def _request(self, variant: Setting) -> dict[str, Any]:
        """Return what is scored in the runs of a variant."""
        sampled = self.runner.scenario(variant).score.sampled_frames
        windows = self.units.windows(self._values)
        if variant.kind == MEASURES:
            windows = [*self.units.parts]
        if variant.kind == SCENARIO:
            sampled = self.reference_frames
        return {"windows": windows, "sampled_frames": sampled, "by_detector": self._tries_detectors(variant)}

    def _tries_detectors(self, variant: Setting) -> bool:
        return variant.kind == SCENARIO and self._values.detectors and self.scenario.score.rank_by == DEFAULT_SCORE

    @property
    def reference_frames(self) -> int:
        """Number of frames of a run that the scenario's scores over vehicles use in the study."""
        sampled = self.scenario.score.sampled_frames
        if self._n_mounts * sampled * OVERSAMPLING > MAX_REFERENCE_SCANS:
            return sampled
        return OVERSAMPLING * sampled

    def _seeded(self, variant: Setting, seed: int) -> Setting:
        if self.scenario.is_recorded or seed == self.scenario.seed:
            return variant
        return replace(variant, overrides=(*variant.overrides, f"seed={seed}"))

    def _saved(self, variant: Setting, seed: int) -> RunScores | None:
        seeded, request = self._seeded(variant, seed), self._request(variant)
        saved = self.runner.saved_result(seeded, request)
        if saved is None:
            return None
        with self.runner.reject_altered(seeded, request):
            return RunScores.from_json(saved)

    def _score_run(self, variant: Setting, seed: int) -> RunScores:
        """Return the scores of a variant with one seed."""
        saved = self._saved(variant, seed)
        if saved is not None:
            return saved
        seeded, request = self._seeded(variant, seed), self._request(variant)
        with self.runner.open_run(seeded) as work:
            scores = score_run(work, **request)
        self.runner.save_result(seeded, request, scores.to_json())
        return scores

    def _by_cost(self, variants: Sequence[Setting]) -> list[Setting]:
        """Return the settings other than the scenario's, cheap ones first; approximations first among similar ones."""

        def order(variant: Setting) -> tuple[int, bool, float]:
            wall_s = self._expected_s(variant)
            return math.frexp(wall_s)[1], variant.kind == MEASURES, wall_s

        return sorted((variant for variant in variants if variant.kind != SCENARIO), key=order)

    def _run_variant(self, variant: Setting) -> None:
        """Measure the stages of a setting and score its runs, unless the budget does not allow it or it fails."""
        if self._saved(variant, self.seeds[0]) is None and _MARGIN * self._expected_s(variant) > self.left_s:
            self._skip(variant.name, BEYOND_BUDGET)
            return
        try:
            self.seconds[variant.name] = self.runner.measure_stages(variant)
            if self._changes_scores(variant):
                seeds = self.seeds[:1] if self.scenario.is_recorded else self.seeds[:MIN_UNITS]
                self.runs[variant.name] = [self._score_run(variant, seed) for seed in seeds]
        except EgvsError as error:
            self.seconds.pop(variant.name, None)
            self._skip(variant.name, str(error))
            return
        self._listener(variant.name, "done", {"seconds": sum(self.seconds[variant.name].values())})

    def _changes_scores(self, variant: Setting) -> bool:
        """Whether a setting needs scores of its own.

        Voxels and frame periods do not change what sites see of vehicles.
        """
        ranks_vehicles = self.scenario.score.rank_by in TARGET_SCORES
        return not (ranks_vehicles and variant.knob in ("voxel", PERIOD_KNOB))

    def _expected_s(self, variant: Setting) -> float:
        """Estimate the wall-clock time of :meth:`_run_variant` from that of the scenario."""
        stages = self.runner.median_seconds(self.stage_keys)
        scenario = self.runner.scenario(variant)
        finer = max(1.0, self.scenario.roi.voxel_m / scenario.roi.voxel_m)
        runs = 1 if self.scenario.is_recorded else MIN_UNITS
        if not self._changes_scores(variant):
            runs = 1
        simulated_s = 0.0
        if _traffic_key(scenario) != _traffic_key(self.scenario):
            simulated_s = stages["traffic"] * simulation_steps(scenario) / simulation_steps(self.scenario)
        counted_s = 0.0
        if simulated_s or scenario.roi != self.scenario.roi:
            counted_s = stages["tpog"] * finer**3
        scanned_s = 0.0
        if scenario.sensors != self.scenario.sensors:
            scanned_s = stages["scan"]
        score_s = stages["score"] * finer**2
        return scanned_s + score_s + runs * (simulated_s + counted_s + score_s)


def _traffic_key(scenario: Scenario) -> tuple[object, ...]:
    """Return what traffic depends on, among the values that settings change."""
    effects = registry.scenario_effects(scenario, "traffic")
    return (scenario.traffic, *(effect.parameters for effect in effects))


def simulation_steps(scenario: Scenario) -> float:
    """Return the number of steps that SUMO simulates, warm-up included."""
    traffic = scenario.traffic
    duration_s = study_settings.counted_frames(scenario) * traffic.frame_period_s
    return (traffic.warmup_s + duration_s) / traffic.step_s
