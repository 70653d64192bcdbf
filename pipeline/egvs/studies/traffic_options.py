r"""What options of the traffic cost: SUMO's step, sublanes and routing, beside what another seed changes.

With another step, other sublanes or other routes, the random numbers of SUMO fall differently: the traffic is another
draw, and its scores differ even where the option has no influence. So each option is compared with the scenario, and so
are some other seeds. A change is *within the spread of seeds* if it is at most

.. math:: \bar v + t_{m-1,\;0.95}\; s \sqrt{1 + 1 / m}

with the mean :math:`\bar v` and the standard deviation s of the changes by m seeds. That is the upper end of a
one-sided 95 % prediction interval: of options without influence, about one in twenty is above it. Three seeds detect
large influences only; a small one needs many runs of each option (``python -m benchmarks.steps``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from egvs.artefacts.tpog import Tpog
from egvs.core.special import stdtrit
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig
from egvs.studies.score_errors import SettingResult
from egvs.studies.study_settings import SEED_KNOB, TRAFFIC, Setting, SettingValues, step_settings

_PREDICTION_LEVEL = 0.95

STEP_KNOB, SUBLANES_KNOB, ROUTING_KNOB = "step", "sublanes", "routing"

OPTION_KNOBS = (SEED_KNOB, STEP_KNOB, SUBLANES_KNOB, ROUTING_KNOB)
"""What the options change, in the order of tables."""

_SUBLANES_KEY, _ROUTING_KEY, _STEP_KEY = "lateral_resolution_m", "reroute_at_departure", "step_s"


def traffic_option_settings(scenario: Scenario, values: SettingValues) -> Iterator[Setting]:
    """Yield other seeds, and SUMO's steps, sublanes and routing where they have an effect.

    Parameters
    ----------
    scenario
        The scenario.
    values
        Values to try.
    """
    if scenario.is_recorded:
        return
    for number in range(1, values.traffic_seeds + 1):
        seed = scenario.seed + number
        yield Setting(f"seed {seed}", TRAFFIC, SEED_KNOB, (f"seed={seed}",))
    if not values.traffic_options:
        return
    traffic = scenario.traffic
    yield from step_settings(scenario, values.traffic_steps_s, TRAFFIC)
    resolution_m, name = 0.0, "without sublanes"
    if traffic.lateral_resolution_m == 0.0:
        resolution_m = TrafficConfig.model_fields[_SUBLANES_KEY].default
        name = f"sublanes of {resolution_m:g} m"
    yield Setting(name, TRAFFIC, SUBLANES_KNOB, (f"traffic.{_SUBLANES_KEY}={resolution_m}",))
    if not why_without_effect(scenario, _ROUTING_KEY):
        name = "routes on empty streets" if traffic.reroute_at_departure else "routes by traffic at departure"
        value = str(not traffic.reroute_at_departure).lower()
        yield Setting(name, TRAFFIC, ROUTING_KNOB, (f"traffic.{_ROUTING_KEY}={value}",))


def options_without_effect(scenario: Scenario, values: SettingValues) -> dict[str, str]:
    """Return why options of the traffic are left out, by the option.

    Parameters
    ----------
    scenario
        The scenario.
    values
        Values to try.
    """
    if not values.traffic_options:
        return {}
    reasons = {}
    options = (("SUMO's step", _STEP_KEY), (SUBLANES_KNOB, _SUBLANES_KEY), (ROUTING_KNOB, _ROUTING_KEY))
    for option, key in options:
        if reason := why_without_effect(scenario, key):
            reasons[option] = reason
    return reasons


def why_without_effect(scenario: Scenario, key: str) -> str:
    """Return why a key of ``[traffic]`` has no effect in any period; empty if it has one."""
    reason = ""
    for period in scenario.by_period().values():
        reason = _why_without_effect_in_period(period.traffic, key)
        if not reason:
            return ""
    return reason


def _why_without_effect_in_period(traffic: TrafficConfig, key: str) -> str:
    if traffic.fcd is not None:
        return "the traffic is a finished file"
    if key != _ROUTING_KEY:
        return ""
    if traffic.sumocfg is not None:
        return "the SUMO configuration sets the routes"
    if traffic.routes:
        return "route files set the routes"
    if traffic.counts:
        return "counted traffic has routes of its own"
    return ""


def tpog_change(tpog: Tpog, base: Tpog) -> float:
    """Return the sum of absolute changes of the occupancy, relative to its sum; NaN for another grid or empty traffic.

    Parameters
    ----------
    tpog, base
        TPOGs on the same grid.
    """
    total = base.p.sum()
    if tpog.grid != base.grid or not total > 0.0:
        return math.nan
    return float(np.abs(tpog.p - base.p).sum() / total)


@dataclass(frozen=True)
class SeedSpread:
    """Changes that may be due to another seed.

    Attributes
    ----------
    seeds
        Number of other seeds.
    tpog, score
        Largest change of the TPOG, and of a site's score, that is within the spread; NaN with fewer than two seeds.
    """

    seeds: int
    tpog: float
    score: float

    @classmethod
    def from_rows(cls, rows: Sequence[SettingResult]) -> SeedSpread:
        """Compute it from the rows of other seeds among the rows of a study."""
        seeds = [row for row in rows if row.kind == TRAFFIC and row.knob == SEED_KNOB]
        tpog = _prediction_limit([row.tpog_change for row in seeds])
        return cls(len(seeds), tpog, _prediction_limit([row.error for row in seeds]))

    def verdict(self, row: SettingResult) -> str:
        """Return whether the changes by an option are within the spread of seeds.

        Parameters
        ----------
        row
            An option.
        """
        if row.tpog_change == 0.0 and row.error == 0.0:
            return "the same traffic"
        if math.isnan(self.tpog) or math.isnan(row.tpog_change):
            return "unknown"
        larger = []
        if row.tpog_change > self.tpog:
            larger.append("TPOG")
        if row.error > self.score:
            larger.append("scores")
        if not larger:
            return "within the spread of seeds"
        return f"{' and '.join(larger)}: beyond it"


def _prediction_limit(changes: Sequence[float]) -> float:
    """Return the upper end of the prediction interval for one more change; NaN for fewer than two."""
    count = len(changes)
    if count < 2:
        return math.nan
    scatter = float(np.std(changes, ddof=1)) * math.sqrt(1.0 + 1.0 / count)
    return float(np.mean(changes)) + float(stdtrit(count - 1, _PREDICTION_LEVEL)) * scatter
