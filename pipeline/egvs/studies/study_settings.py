r"""The settings that an accuracy study prices.

A study changes one setting at a time, and prices each with the scenario's amount of traffic, and with parts and
multiples of it. There are two kinds:

- Settings that *approximate* the scenario's decision: less or more traffic, fewer or more frames for detection, longer
  frame periods and SUMO steps, no sublanes, the quality of an effect, and ranking by the vehicles found where another
  score ranks.
- Settings that *measure* something else: another voxel size or gamma, the model of one detector, thinned beams, other
  routes, without an effect of the scenario, or with an effect that it does not name. Such effects are tried if they
  need no parameter from the user (as a rain rate) and act in this scene.

Each setting is a list of ``--set`` overrides, so that users can type the recommended one. If only every f-th beam is
cast, a voxel has n instead of about f n hits. Because :math:`\min(\gamma, f n) = f \min(\gamma / f, n)`, thinned
settings divide gamma by f; scores as shares of ``egvs_limit`` are then the same as with weights. Scores over vehicles
count points, so thinned beams are another sensor for them.

Traffic with periods is lengthened or shortened by the same factor in each period, whether the period has its own
``length_s`` or uses ``traffic.frames``. Frames are always complete blocks.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.effects import registry
from egvs.effects.base import Echo
from egvs.effects.registry import AUTO_ENABLED
from egvs.results.studies import APPROXIMATES, MEASURES, SCENARIO
from egvs.scenario.model import Scenario
from egvs.sensors import sites
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.stages.inputs import build_scene
from egvs.traffic.finished_fcd import recorded_frames

PERIOD_KNOB, STEP_KNOB, SUBLANES_KNOB, ROUTING_KNOB = "period", "step", "sublanes", "routing"
"""What is changed: the frame period, SUMO's step, sublanes, and routing."""

WITHOUT_PREFIX, WITH_PREFIX = "without ", "with "
"""Prefixes of settings that leave out an effect, or add one."""


@dataclass(frozen=True)
class Setting:
    """One setting of the study.

    Attributes
    ----------
    name
        Description of what changes; unique in a study.
    kind, knob
        ``SCENARIO``, ``APPROXIMATES`` or ``MEASURES``, and what is changed.
    overrides
        Arguments of ``--set``.
    without
        An effect that is left out.
    weight
        How many beams of the scenario one thinned beam stands for.
    """

    name: str
    kind: str
    knob: str
    overrides: tuple[str, ...] = ()
    without: str | None = None
    weight: float = 1.0

    def to_options(self) -> str:
        """Return the overrides as options of a command."""
        return " ".join(f"--set {shlex.quote(override)}" for override in self.overrides)


SCENARIO_AS_IS = Setting(SCENARIO, SCENARIO, "")
"""The scenario without changes."""


@dataclass(frozen=True)
class PricedSetting:
    """A setting with an amount of traffic: a row of the study.

    Attributes
    ----------
    setting
        Description and overrides of everything, traffic included.
    variant
        Name of the setting whose runs it takes part of.
    units
        Length of the traffic in runs of the scenario's length; below 1 for a part of one.
    blocks
        The same in blocks of one run, if it is a part of one; else 0.
    sampled_frames
        Number of frames for scores over vehicles.
    score
        Score that chooses, if it is not the one that ranks.
    """

    setting: Setting
    variant: str
    units: float
    blocks: int
    sampled_frames: int
    score: str = ""


@dataclass(frozen=True)
class SettingValues:
    """Values that a study tries.

    Attributes
    ----------
    traffic_parts
        Parts of the scenario's traffic, rounded to complete blocks.
    traffic_factors
        How many times as long as the scenario's traffic.
    sampled_factors
        How many times as many frames for scores over vehicles.
    frame_periods_s, steps_s
        Seconds between frames, and SUMO's steps.
    thinning_factors
        Every n-th azimuth.
    voxels_m, gammas
        Edges of voxels, and values of ``score.gamma``.
    detectors
        Whether the model of each detector alone is tried.
    unnamed_effects
        Whether effects that the scenario does not name are tried.
    traffic_options
        Whether sublanes and routing are tried.
    """

    traffic_parts: Sequence[float] = (0.1, 0.2, 0.5)
    traffic_factors: Sequence[int] = (2, 4)
    sampled_factors: Sequence[float] = (0.2, 0.4, 2.0, 3.0)
    frame_periods_s: Sequence[float] = (0.5, 1.0, 2.0)
    steps_s: Sequence[float] = (0.25, 0.5, 1.0)
    thinning_factors: Sequence[int] = (2, 4)
    voxels_m: Sequence[float] = (1.0, 0.5, 0.25)
    gammas: Sequence[float] = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
    detectors: bool = True
    unnamed_effects: bool = True
    traffic_options: bool = True


DEFAULT_VALUES = SettingValues()


def counted_frames(scenario: Scenario) -> int:
    """Return the number of frames in the TPOG, over all periods; frames after the last complete block do not count."""
    return sum(map(_frames_in_blocks, scenario.by_period().values()))


def traffic_length_overrides(scenario: Scenario, factor: float, period_s: float) -> tuple[int, tuple[str, ...]]:
    """Find the overrides that lengthen or shorten all traffic of a scenario.

    Parameters
    ----------
    scenario
        The scenario.
    factor
        How many times as long as now.
    period_s
        Seconds between frames.

    Returns
    -------
    frames : int
        Number of frames; 0 if a period would have no block, or if periods are finished files, which are not scaled.
    overrides : tuple of str
        Arguments of ``--set`` for all lengths that change.
    """
    traffic = scenario.traffic
    is_unchanged = factor == 1.0 and period_s == traffic.frame_period_s
    if traffic.periods and scenario.is_recorded and not is_unchanged:
        return 0, ()

    lengths_s = {period.name: period.length_s for period in traffic.periods}
    frames_by_period = []
    overrides: dict[str, int | float] = {}
    for number, (name, period) in enumerate(scenario.by_period().items()):
        current = _frames_in_blocks(period)
        blocks = round(current * traffic.frame_period_s * factor / period_s / scenario.tpog.blocks)
        frames = blocks * scenario.tpog.blocks
        frames_by_period.append(frames)
        length_s = lengths_s.get(name)
        scaled_s = float(f"{frames * period_s:.9g}")
        if length_s is None and frames != current:
            overrides["traffic.frames"] = frames
        elif length_s is not None and scaled_s != length_s:
            overrides[f"traffic.periods.{number}.length_s"] = scaled_s
    if 0 in frames_by_period:
        return 0, ()
    return sum(frames_by_period), tuple(f"{key}={value}" for key, value in overrides.items())


def _frames_in_blocks(period: Scenario) -> int:
    frames = recorded_frames(period)
    return frames - frames % period.tpog.blocks


def list_variants(scenario: Scenario, values: SettingValues = DEFAULT_VALUES) -> list[Setting]:
    """List the settings that need runs of their own, the scenario first; without :mod:`egvs.studies.traffic_options`.

    Parameters
    ----------
    scenario
        The scenario.
    values
        Values to try.
    """
    variants = [SCENARIO_AS_IS, *_period_settings(scenario, values)]
    if not scenario.is_recorded:
        variants += _step_settings(scenario, values.steps_s)
    variants += [*_effect_quality_settings(scenario), *_thinned_sensor_settings(scenario, values)]
    variants += _measure_settings(scenario, values)
    distinct: dict[tuple[object, ...], Setting] = {}
    for variant in variants:
        distinct.setdefault((variant.overrides, variant.without), variant)
    return list(distinct.values())


def _period_settings(scenario: Scenario, values: SettingValues) -> Iterator[Setting]:
    for period_s in values.frame_periods_s:
        yield from _scaled_traffic_setting(scenario, PERIOD_KNOB, None, period_s)


def _step_settings(scenario: Scenario, steps_s: Sequence[float]) -> Iterator[Setting]:
    """Yield settings with other SUMO steps, and the nearest frame period that is a multiple of the step.

    Parameters
    ----------
    scenario
        The scenario.
    steps_s
        Steps to try.
    """
    for step_s in steps_s:
        period_s = _nearest_period(step_s, scenario.traffic.frame_period_s)
        yield from _scaled_traffic_setting(scenario, STEP_KNOB, step_s, period_s)


def _nearest_period(step_s: float, period_s: float) -> float:
    """Return the multiple of a step that is nearest to the scenario's frame period."""
    if _divides(step_s, period_s):
        return period_s
    return max(1, int(period_s / step_s)) * step_s


def _scaled_traffic_setting(scenario: Scenario, knob: str, step_s: float | None, period_s: float) -> Iterator[Setting]:
    """Yield the setting with such traffic, if steps and periods divide, and if it differs from the scenario."""
    traffic = scenario.traffic
    step_s = step_s or traffic.step_s
    frames, length_overrides = traffic_length_overrides(scenario, 1.0, period_s)
    is_possible = _divides(step_s, period_s) and _divides(step_s, traffic.warmup_s)
    if frames == 0 or not (is_possible or scenario.is_recorded):
        return
    parts = []
    overrides = list(length_overrides)
    if step_s != traffic.step_s:
        parts.append(f"step {step_s:g} s")
        overrides.append(f"traffic.step_s={step_s}")
    if period_s != traffic.frame_period_s:
        parts.append(f"a frame every {period_s:g} s")
        overrides.append(f"traffic.frame_period_s={float(f'{period_s:.6g}')}")
    if parts:
        yield Setting(", ".join(parts), APPROXIMATES, knob, tuple(overrides))


def _divides(part: float, total: float) -> bool:
    return abs(total / part - round(total / part)) < 1e-9


def _thinned_sensor_settings(scenario: Scenario, values: SettingValues) -> Iterator[Setting]:
    """Yield settings with every n-th azimuth and every second channel; EGVS is weighted for them."""
    candidates = sites.candidate_sites(scenario)
    if any(site.points is not None for site in candidates):
        return
    names = dict.fromkeys(site.sensor for site in candidates)
    sensors = [scenario_sensor(name, scenario, f"{scenario.file}: sensors") for name in names]
    if any(sensor.table is not None for sensor in sensors):
        return

    for factor in values.thinning_factors:
        if any(sensor.azimuths % factor for sensor in sensors):
            continue
        overrides: list[str] = []
        for sensor in sensors:
            overrides += _sensor_overrides(scenario, sensor, factor, range(sensor.channels))
        suffix = "nd" if factor == 2 else "th"
        yield _thinned_setting(scenario, f"every {factor}{suffix} azimuth", "azimuth", overrides, float(factor))

    weights = set()
    overrides = []
    for sensor in sensors:
        channels = sorted(range(sensor.channels), key=sensor.elevations_deg.__getitem__)[::2]
        weights.add(sensor.channels / len(channels))
        overrides += _sensor_overrides(scenario, sensor, 1, channels)
    if len(weights) == 1 and weights != {1.0}:
        yield _thinned_setting(scenario, "every 2nd channel", "channels", overrides, weights.pop())


def _thinned_setting(scenario: Scenario, name: str, knob: str, overrides: list[str], weight: float) -> Setting:
    if scenario.score.rank_by != "egvs":
        return Setting(name, MEASURES, knob, tuple(overrides))
    gamma = f"score.gamma={scenario.gamma / weight}"
    return Setting(name, MEASURES, knob, (*overrides, gamma), weight=weight)


def _sensor_overrides(scenario: Scenario, sensor: Sensor, factor: int, channels: Sequence[int]) -> Iterator[str]:
    """Yield overrides that define a sensor of the same name with every ``factor``-th azimuth of some channels."""
    config = scenario.sensors.get(sensor.name)
    step_deg = sensor.azimuth_step_deg
    if config is not None:
        step_deg = config.azimuth_step_deg
    step_deg = (step_deg or 360.0) * factor
    values: dict[str, object] = {"azimuth_step_deg": step_deg}
    if sensor.azimuth_deg is not None:  # from the first azimuth to the last one that remains
        first_deg = sensor.azimuth_deg[0]
        values["azimuth_deg"] = [first_deg, first_deg + step_deg * (sensor.azimuths // factor - 1)]
    if len(channels) < sensor.channels or config is None:
        values["elevations_deg"] = [sensor.elevations_deg[channel] for channel in channels]
        values["azimuth_offsets_deg"] = [sensor.azimuth_offsets_deg[channel] for channel in channels]
        values["channels"] = len(channels)
    if config is None:
        values["range_m"] = sensor.range_m
    if config is None and scenario.effects.named:
        for name in ("wavelength_nm", "divergence_mrad", "rated_range_m", "rated_reflectivity"):
            if getattr(sensor, name) is not None:
                values[name] = getattr(sensor, name)
    for key, value in values.items():
        yield f"sensors.{sensor.name}.{key}={json.dumps(value)}"


def _measure_settings(scenario: Scenario, values: SettingValues) -> Iterator[Setting]:
    """Yield settings with other voxels, other gammas for EGVS, and other effects.

    Voxels are tried with the same gamma and, for EGVS, with gamma in proportion to a face of the voxel. Scores over
    vehicles do not depend on voxels, only their cost does.
    """
    current_m = scenario.roi.voxel_m
    gamma = scenario.gamma
    is_egvs = scenario.score.rank_by == "egvs"
    for voxel_m in values.voxels_m:
        if voxel_m == current_m or not _fits(scenario, voxel_m):
            continue
        overrides = (f"roi.voxel_m={voxel_m}",)
        yield Setting(f"voxel {voxel_m:g} m", MEASURES, "voxel", overrides)
        scaled = gamma * (voxel_m / current_m) ** 2
        if scaled != gamma and is_egvs:
            name = f"voxel {voxel_m:g} m, gamma {scaled:g}"
            yield Setting(name, MEASURES, "voxel and gamma", (*overrides, f"score.gamma={scaled}"))
    if is_egvs:
        for other_gamma in values.gammas:
            if other_gamma != gamma:
                yield Setting(f"gamma {other_gamma:g}", MEASURES, "gamma", (f"score.gamma={other_gamma}",))
    for name in scenario.effects.named:
        yield Setting(f"{WITHOUT_PREFIX}{name}", MEASURES, "effect", (), without=name)
    if values.unnamed_effects:
        if registry.LOSSES not in scenario.effects.named and _has_losses(scenario):
            yield Setting(f"{WITHOUT_PREFIX}{registry.LOSSES}", MEASURES, "effect", (), without=registry.LOSSES)
        for name in _acting_effects(scenario):
            yield Setting(f"{WITH_PREFIX}{name}", MEASURES, "effect", (f"effects.{name}={{}}",))


def _has_losses(scenario: Scenario) -> bool:
    """Whether losses of returns act although the scenario does not name them."""
    losses = build_scene(scenario).losses
    return losses is not None and bool(losses.acting)


def _acting_effects(scenario: Scenario) -> Iterator[str]:
    """Yield effects on scores that the scenario does not name, that need no parameter, and that act in its scene."""
    scene = None
    for name in registry.effect_names():
        if name in scenario.effects.named or name in AUTO_ENABLED or registry.required_parameters(name):
            continue
        if name == registry.LOSSES and scenario.effects.range_limit is not False:
            continue  # it acts where it changes a result
        scene = scene or build_scene(scenario)
        kind = registry.load_effect_class(name)
        if issubclass(kind, Echo):
            continue
        effect = kind(kind.Model())
        if effect.why_idle(scene) is None and effect.refusal(scene) is None:
            yield name


def _fits(scenario: Scenario, voxel_m: float) -> bool:
    """Whether the region of interest is a whole number of such voxels."""
    try:
        Grid.over(scenario.roi.box, voxel_m, "")
    except InputError:
        return False
    return True


def _effect_quality_settings(scenario: Scenario) -> Iterator[Setting]:
    """Yield other values of each effect's ``QUALITY`` parameters, whose values are listed from cheap to fine."""
    for name, named in scenario.effects.named.items():
        effect = registry.make_effect(name, named)
        parameters = named.model_dump(mode="json", exclude_unset=True)
        for key, values in effect.QUALITY.items():
            try:
                registry.load_effect_class(name).Model.from_dict({**parameters, key: values[0]})
            except ValidationError:  # the effect uses another method, without this parameter
                continue
            current = getattr(effect.parameters, key)
            for value in reversed(values):
                if value != current:
                    overrides = (f"effects.{name}.{key}={json.dumps(value)}",)
                    yield Setting(f"{name} {key} {value}", APPROXIMATES, name, overrides)
