r"""The settings that the study tries.

How long a setting watches traffic: the ``--set`` overrides that lengthen or shorten all of it alike.

Where the traffic has periods, each is watched ``times`` as long, whether its time is its own (``length_s``) or that of
``traffic.frames``. Frames are whole blocks.

The settings that the accuracy study tries.

One knob at a time around the scenario's own setting, and a small full grid of those that cost most. Two kinds, which
are never mixed: a setting that *approximates* the scenario's number more or less well (how long and how finely traffic
is watched, how coarsely SUMO steps, beams thinned and weighted up, the quality of an effect), and one that *measures*
something else (voxel, gamma, without an effect that is named, with one that is not). Effects that are not named are
tried where they need no number of the user's (a rate of rain, a sensor's rated range) and change something in this
scene.

Every setting is a list of ``--set`` overrides, so that what the study recommends can be typed. Thinned beams need no
code of their own: with every f-th beam a voxel has hits n, weighted up f n, and :math:`\min(\gamma, f n) = f
\min(\gamma / f, n)`; so gamma is divided by f, and the share of ``egvs_limit`` stays exactly what it is with weights.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import ValidationError

from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.effects import registry
from egvs.effects.registry import SELF_ACTIVATING
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import DEFAULT_FRAMES as FRAMES_OF_A_SCENARIO
from egvs.scenario.traffic_config import TrafficConfig
from egvs.sensors import sites
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.stages.inputs import build_scene
from egvs.traffic.finished_fcd import recorded_frames


def counted_frames(scenario: Scenario) -> int:
    """Frames that the TPOG counts, in all periods: as the scenario says, or the whole blocks of a finished file."""
    return sum(map(_frames_in_blocks, scenario.by_period().values()))


def is_finished(scenario: Scenario) -> bool:
    """Whether any of the traffic is a finished file, which cannot last longer."""
    return any(alone.traffic.fcd is not None for alone in scenario.by_period().values())


def scale_traffic(scenario: Scenario, times: float, period_s: float) -> tuple[int, tuple[str, ...]]:
    """Frames in all, and the overrides, of traffic that is watched ``times`` as long with a frame every ``period_s``.

    No frames where one of the periods would have none, or where only some of them could be cut: those of finished
    files.
    """
    own, alone = scenario.traffic, scenario.by_period()
    if own.periods and is_finished(scenario) and (times, period_s) != (1.0, own.frame_period_s):
        return 0, ()
    frames = {name: _scaled_frames(scenario, _frames_in_blocks(one), times, period_s) for name, one in alone.items()}
    overrides = dict(_length_overrides(scenario, frames, period_s))
    return (0 if 0 in frames.values() else sum(frames.values())), tuple(f"{k}={v}" for k, v in overrides.items())


def _length_overrides(scenario: Scenario, frames: dict[str, int], period_s: float) -> Iterator[tuple[str, int | float]]:
    """Key and value of each length that is another than the scenario's."""
    own = {name: _frames_in_blocks(one) for name, one in scenario.by_period().items()}
    lengths_s = {period.name: period.length_s for period in scenario.traffic.periods}
    for number, (name, its) in enumerate(frames.items()):
        length_s = lengths_s.get(name)
        if length_s is None and its != own[name]:
            yield "traffic.frames", its
        elif length_s is not None and (watched_s := float(f"{its * period_s:.9g}")) != length_s:
            yield f"traffic.periods.{number}.length_s", watched_s


def _scaled_frames(scenario: Scenario, frames: int, times: float, period_s: float) -> int:
    blocks = scenario.tpog.blocks
    return round(frames * scenario.traffic.frame_period_s * times / period_s / blocks) * blocks


def _frames_in_blocks(alone: Scenario) -> int:
    frames = recorded_frames(alone)
    return frames - frames % alone.tpog.blocks


APPROXIMATES, MEASURES, REFERENCE, SCENARIO = "approximates", "measures", "reference", "scenario"
WITHOUT_PREFIX, WITH_PREFIX = "without ", "with "
"""How the names of settings begin that leave out an effect, or switch one on."""

FRAMES = (250, 500, 1000, 2500)
LONGER = (2, 4, 8)
"""Times the scenario's own traffic."""
PERIODS_S = (0.5, 1.0, 2.0)
STEPS_S = (0.05, 0.1, 0.5, 1.0)
THINNING_FACTORS = (2, 4)
VOXELS_M = (1.0, 0.5, 0.25, 0.125)
GAMMAS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
GRID_LONGER, GRID_WATCHED_S = (1, 4, 8, 16), ((None, None), (None, 1.0), (0.5, 1.0), (1.0, 1.0))
"""The grid: lengths of the traffic, and pairs of SUMO step and frame period (None: the scenario's)."""


@dataclass(frozen=True)
class Setting:
    """One setting of the study.

    Attributes
    ----------
    name
        What distinguishes it, in words; unique.
    kind, knob
        ``APPROXIMATES`` or ``MEASURES``, and which knob is turned.
    overrides
        As after ``--set``.
    without
        An effect that is left out.
    weight
        What each beam stands for, where beams are thinned.
    baseline
        The setting with the same traffic that shows what the knob alone does.
    steps
        SUMO's steps, where traffic is simulated anew.
    """

    name: str
    kind: str
    knob: str
    overrides: tuple[str, ...] = ()
    without: str | None = None
    weight: float = 1.0
    baseline: str = SCENARIO
    steps: float = 0.0


SCENARIO_AS_IS = Setting(SCENARIO, SCENARIO, "")
"""The scenario as it is."""


def reference_setting(scenario: Scenario, times: int) -> Setting:
    """The scenario with its traffic watched for ``times`` as long."""
    _, overrides = scale_traffic(scenario, times, scenario.traffic.frame_period_s)
    return Setting(REFERENCE, REFERENCE, "frames", overrides if times > 1 else ())


def is_default(scenario: Scenario, base: Scenario) -> bool:
    """Whether traffic is watched as a scenario that says nothing about it has it, and all else is as in ``base``."""
    defaults = {key: TrafficConfig.model_fields[key].default for key in ("frame_period_s", "step_s")}
    defaults["frames"] = FRAMES_OF_A_SCENARIO
    return not is_finished(base) and scenario == base.model_copy(
        update={"traffic": base.traffic.model_copy(update=defaults)}
    )


def list_settings(scenario: Scenario) -> list[Setting]:
    """All settings but the reference, the scenario's own first; the cheap and telling ones before the others."""
    distinct: dict[tuple[object, ...], Setting] = {}
    watched = sorted(_traffic_settings(scenario), key=lambda setting: setting.steps)
    for setting in (
        SCENARIO_AS_IS,
        *_measure_settings(scenario),
        *_effect_quality_settings(scenario),
        *_thinned_sensor_settings(scenario),
        *watched,
    ):
        distinct.setdefault((setting.overrides, setting.without), setting)
    return list(distinct.values())


def _traffic_settings(scenario: Scenario) -> Iterator[Setting]:
    """How long and how finely traffic is watched."""
    own, own_frames = scenario.traffic, counted_frames(scenario)
    for few in FRAMES:
        frames, overrides = scale_traffic(scenario, few / own_frames, own.frame_period_s)
        if 0 < frames < own_frames and (frames == few or own.periods):
            yield Setting(f"{frames} frames", APPROXIMATES, "frames", overrides)
    for period_s in PERIODS_S:
        yield from _scaled_traffic_setting(scenario, "period", 1, None, period_s)
    if is_finished(scenario):
        return
    for step_s in STEPS_S:
        yield from _scaled_traffic_setting(scenario, "step", 1, step_s, _period_with(step_s, own.frame_period_s))
    for times in LONGER:
        yield from _scaled_traffic_setting(scenario, "frames", times, None, None)
    for times in GRID_LONGER:
        for step, period in GRID_WATCHED_S:
            yield from _scaled_traffic_setting(scenario, "grid", times, step, period)


def _period_with(step_s: float, period_s: float) -> float | None:
    """The frame period nearest to the scenario's that a step divides; None for the scenario's own."""
    if _divides(step_s, period_s):
        return None
    return max(1, int(period_s / step_s)) * step_s


def _scaled_traffic_setting(
    scenario: Scenario, knob: str, times: int, step_s: float | None, period_s: float | None
) -> Iterator[Setting]:
    """Traffic ``times`` as long as the scenario's, so stepped and watched; nothing where times do not divide."""
    own = scenario.traffic
    step, period = step_s or own.step_s, period_s or own.frame_period_s
    frames, longer = scale_traffic(scenario, times, period)
    simulated = not is_finished(scenario)
    if frames == 0 or (simulated and not (_divides(step, period) and _divides(step, own.warmup_s))):
        return
    name, overrides = f"{frames} frames", list(longer)
    if period != own.frame_period_s:
        name += f" every {period:g} s"
        overrides.append(f"traffic.frame_period_s={float(f'{period:.6g}')}")
    if step != own.step_s:
        name += f", step {step:g} s"
        overrides.append(f"traffic.step_s={step}")
    if overrides:
        steps = (own.warmup_s + frames * period) / step
        yield Setting(name, APPROXIMATES, knob, tuple(overrides), steps=steps)


def _divides(part: float, total: float) -> bool:
    return abs(total / part - round(total / part)) < 1e-9


def _thinned_sensor_settings(scenario: Scenario) -> Iterator[Setting]:
    """Every second and fourth azimuth, every second channel; weighted up, which the EGVS alone can be."""
    if scenario.score.rank_by != "egvs":
        return
    candidates = sites.candidate_sites(scenario)
    if any(site.points is not None for site in candidates):
        return
    names = dict.fromkeys(site.sensor for site in candidates)
    used = [scenario_sensor(name, scenario, f"{scenario.file}: sensors") for name in names]
    if any(sensor.table is not None for sensor in used):
        return
    for factor in THINNING_FACTORS:
        if all(sensor.azimuths % factor == 0 for sensor in used):
            changes = [o for s in used for o in _sensor_overrides(scenario, s, factor, range(s.channels))]
            ordinal = "2nd" if factor == 2 else f"{factor}th"
            yield _weighted_setting(scenario, f"every {ordinal} azimuth", "azimuth", changes, float(factor))
    kept = [sorted(range(s.channels), key=lambda ring, s=s: s.elevations_deg[ring])[::2] for s in used]  # type: ignore[misc]
    weights = {s.channels / len(rings) for s, rings in zip(used, kept, strict=True)}
    if len(weights) == 1 and weights != {1.0}:
        changes = [o for s, rings in zip(used, kept, strict=True) for o in _sensor_overrides(scenario, s, 1, rings)]
        yield _weighted_setting(scenario, "every 2nd channel", "channels", changes, weights.pop())


def _weighted_setting(scenario: Scenario, name: str, knob: str, changes: list[str], weight: float) -> Setting:
    gamma = f"score.gamma={scenario.gamma / weight}"
    return Setting(name, APPROXIMATES, knob, (*changes, gamma), weight=weight)


def _sensor_overrides(scenario: Scenario, sensor: Sensor, factor: int, rings: range | list[int]) -> Iterator[str]:
    """Overrides that make a sensor of the same name with fewer beams."""
    own = scenario.sensors.get(sensor.name)
    step = (own.azimuth_step_deg if own is not None else sensor.azimuth_step_deg) or 360.0
    values: dict[str, object] = {"azimuth_step_deg": step * factor}
    if sensor.azimuth_deg is not None:  # from the first azimuth to the last that is left
        first = sensor.azimuth_deg[0]
        values["azimuth_deg"] = [first, first + step * factor * (sensor.azimuths // factor - 1)]
    if len(rings) < sensor.channels or own is None:
        values["elevations_deg"] = [sensor.elevations_deg[r] for r in rings]
        values["azimuth_offsets_deg"] = [sensor.azimuth_offsets_deg[r] for r in rings]
        values["channels"] = len(rings)
    if own is None:
        values["range_m"] = sensor.range_m
    if own is None and scenario.effects.named:
        names = ("wavelength_nm", "divergence_mrad", "rated_range_m", "rated_reflectivity")
        values |= {name: value for name in names if (value := getattr(sensor, name)) is not None}
    for key, value in values.items():
        yield f"sensors.{sensor.name}.{key}={json.dumps(value)}"


def _measure_settings(scenario: Scenario) -> Iterator[Setting]:
    """Other voxels (with gamma as it is, and scaled by the face of a voxel) and other caps, where the score that ranks
    has these; without an effect."""
    own, gamma, rank_by = scenario.roi.voxel_m, scenario.gamma, scenario.score.rank_by
    for voxel_m in VOXELS_M if rank_by in ("egvs", "entropy_seen") else ():
        if voxel_m == own or not _fits(scenario, voxel_m):
            continue
        yield Setting(f"voxel {voxel_m:g} m", MEASURES, "voxel", (f"roi.voxel_m={voxel_m}",))
        scaled = gamma * (voxel_m / own) ** 2
        if scaled != gamma and rank_by == "egvs":
            overrides = (f"roi.voxel_m={voxel_m}", f"score.gamma={scaled}")
            yield Setting(f"voxel {voxel_m:g} m, gamma {scaled:g}", MEASURES, "voxel and gamma", overrides)
    for cap in GAMMAS if rank_by == "egvs" else ():
        if cap != gamma:
            yield Setting(f"gamma {cap:g}", MEASURES, "gamma", (f"score.gamma={cap}",))
    for name in scenario.effects.named:
        yield Setting(f"{WITHOUT_PREFIX}{name}", MEASURES, "effect", (), without=name)
    for name in _others(scenario):
        yield Setting(f"{WITH_PREFIX}{name}", MEASURES, "effect", (f"effects.{name}={{}}",))


def _others(scenario: Scenario) -> Iterator[str]:
    """Effects that are not named, need no parameter, and would act."""
    scene = None
    for name in registry.effect_names():
        if name in scenario.effects.named or name in SELF_ACTIVATING or registry.required_parameters(name):
            continue
        scene = scene or build_scene(scenario)
        kind = registry.find_effect_class(name)
        effect = kind(kind.Model())
        if effect.why_idle(scene) is None and effect.refusal(scene) is None:
            yield name


def _fits(scenario: Scenario, voxel_m: float) -> bool:
    try:
        Grid.over(scenario.roi.box, voxel_m, "")
    except InputError:
        return False
    return True


def _accepts(name: str, parameters: dict[str, object]) -> bool:
    try:
        registry.find_effect_class(name).Model.from_dict(parameters)
    except ValidationError:
        return False
    return True


def _effect_quality_settings(scenario: Scenario) -> Iterator[Setting]:
    """Each named effect's own knobs, whose values its class lists from cheap to fine as ``QUALITY``."""
    for name, named in scenario.effects.named.items():
        effect, parameters = registry.make_effect(name, named), named.model_dump(mode="json", exclude_unset=True)
        for key, values in effect.QUALITY.items():
            own = getattr(effect.parameters, key)
            if not _accepts(name, {**parameters, key: values[0]}):  # a knob of another method
                continue
            finest = SCENARIO if values[-1] == own else f"{name} {key} {values[-1]}"
            for value in reversed(values):
                if value != own:
                    overrides = (f"effects.{name}.{key}={json.dumps(value)}",)
                    beside = SCENARIO if value == values[-1] else finest
                    yield Setting(f"{name} {key} {value}", APPROXIMATES, name, overrides, baseline=beside)
