"""The best mount of each sensor, and what it costs.

The cost is that of the sensor with its pole and height, as ``[costs]`` says. Sensors are compared with the cheapest
one; without costs, with the one that finds least.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.results.labels import format_count
from egvs.results.ranking import RankedSite
from egvs.scenario.score_config import COST_COLUMN, CostsConfig
from egvs.sensors.sites import pole_exists

_PROBABILITY_DIGITS = 6
"""The last bits of a distribution function depend on the machine."""


@dataclass(frozen=True)
class ScoreDifference:
    """A score minus another.

    Attributes
    ----------
    value
        The difference.
    se
        Its standard error; None if unknown.
    better
        Probability that the first score is truly higher; None if unknown.
    is_paired
        Whether both scores come from the same traffic, so that their common scatter cancels in the error.
    """

    value: float
    se: float | None = None
    better: float | None = None
    is_paired: bool = False

    @classmethod
    def of_independent(cls, first: RankedSite, second: RankedSite) -> ScoreDifference:
        """Return the difference of two sites, with the error that it has if their errors are independent."""
        value = first.score - second.score
        if first.score_se is None or second.score_se is None:
            return cls(value)
        se = math.hypot(first.score_se, second.score_se)
        if se > 0.0:
            better = NormalDist().cdf(value / se)
        else:
            better = 0.5 * (1.0 + math.copysign(1.0, value)) if value else 0.5
        return cls(value, se, round(better, _PROBABILITY_DIGITS))

    @classmethod
    def from_entry(cls, entry: Mapping[str, Any]) -> ScoreDifference:
        """Return the paired difference that a command has recorded in the run folder."""
        return cls(entry["value"], entry["se"], entry["better"], is_paired=True)

    def widened(self, half_width: float) -> ScoreDifference:
        """Return the difference with the root mean square of another error added in quadrature."""
        if half_width == 0.0:
            return self
        se = math.hypot(self.se or 0.0, half_width)
        better = round(NormalDist().cdf(self.value / se), _PROBABILITY_DIGITS)
        return replace(self, se=se, better=better)

    @property
    def is_clear(self) -> bool:
        """Whether it is known which score is higher, or errors are unknown."""
        if self.better is None:
            return True
        return max(self.better, 1.0 - self.better) >= DISTINCT_PROBABILITY


@dataclass(frozen=True)
class SensorMount:
    """The best mount of a sensor in a run.

    Attributes
    ----------
    run
        Label of the run; empty where there is only one.
    site
        The best site with this sensor.
    cost
        Its cost; None if unknown.
    """

    run: str
    site: RankedSite
    cost: float | None

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        return self.site.sensor


def best_mounts(
    sites: Iterable[RankedSite], costs: CostsConfig, run: str = "", existing_poles: Sequence[str] = ()
) -> tuple[SensorMount, ...]:
    """Return the best mount of each sensor.

    Parameters
    ----------
    sites
        Sites in the order of their ranks.
    costs
        Costs of the scenario.
    run
        Label of the run.
    existing_poles
        Those of ``[sites]``.
    """
    best: dict[str, RankedSite] = {}
    for site in sites:
        best.setdefault(site.sensor, site)
    return tuple(SensorMount(run, site, site_cost(site, costs, existing_poles)) for site in best.values())


def site_cost(site: RankedSite, costs: CostsConfig, existing_poles: Sequence[str] = ()) -> float | None:
    """Return the cost of a site, from its column ``cost`` or ``[costs]``; None if that of its sensor is unknown."""
    text = dict(site.user_columns).get(COST_COLUMN)
    if text:
        try:
            cost = float(text)
        except ValueError:
            return None
        return cost if 0.0 <= cost < math.inf else None
    if site.sensor not in costs.sensor:
        return None
    return costs.of_mount(site.sensor, site.z_m, pole_exists=pole_exists(site.pole, existing_poles))


@dataclass(frozen=True)
class SensorResult:
    """A sensor compared with the baseline.

    Attributes
    ----------
    mount
        Its best mount.
    gain
        Its score minus that of the baseline; None for the baseline.
    """

    mount: SensorMount
    gain: ScoreDifference | None = None

    @property
    def cost_text(self) -> str:
        """The cost of the mount."""
        return "-" if self.mount.cost is None else format_count(self.mount.cost)

    @property
    def gain_text(self) -> str:
        """The gain with its standard error: in percentage points for shares; ``~`` marks one that is not clear."""
        return "-" if self.gain is None else format_difference(self.gain, self.mount.site)


@dataclass(frozen=True)
class SensorComparison:
    """The best mount of each sensor, the baseline first: the cheapest, or that finding least with fewer than two costs.

    Attributes
    ----------
    results
        By cost, followed by those without a cost by score; all by score with fewer than two costs.
    has_costs
        Whether at least two costs are known, so that they can be compared.
    has_loss_interval
        Whether errors of differences contain the interval of the losses of returns.
    order_at_high_reflectivity
        Names of the sensors, best first, at the highest reflectivity of this interval; empty where it is unknown.
    """

    results: tuple[SensorResult, ...]
    has_costs: bool
    has_loss_interval: bool = False
    order_at_high_reflectivity: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, mounts: Sequence[SensorMount], difference: Callable[[SensorMount, SensorMount], ScoreDifference]
    ) -> SensorComparison | None:
        """Compare sensors; None for fewer than two.

        Parameters
        ----------
        mounts
            Best mounts; several of one sensor if there are several runs.
        difference
            Returns the score of the first mount minus that of the second.
        """
        if len({mount.sensor for mount in mounts}) < 2:
            return None
        has_costs = sum(mount.cost is not None for mount in mounts) > 1

        def order(mount: SensorMount) -> tuple[float, float]:
            if not has_costs:
                return mount.site.score, 0.0
            if mount.cost is None:
                return math.inf, mount.site.score
            return mount.cost, -mount.site.score

        baseline, *others = sorted(mounts, key=order)
        results = [SensorResult(baseline)]
        results += [SensorResult(mount, difference(mount, baseline)) for mount in others]
        return cls(tuple(results), has_costs)

    @classmethod
    def of_run(
        cls, sites: Sequence[RankedSite], costs: CostsConfig, existing_poles: Sequence[str] = ()
    ) -> SensorComparison | None:
        """Compare the sensors of one run, whose sites are by rank; errors of differences as if independent."""
        return cls.of(
            best_mounts(sites, costs, existing_poles=existing_poles),
            lambda mount, other: ScoreDifference.of_independent(mount.site, other.site),
        )

    @property
    def baseline(self) -> SensorMount:
        """The mount that the others are compared with."""
        return self.results[0].mount

    @property
    def baseline_name(self) -> str:
        """The sensor of the baseline, and its run if a sensor is in several runs, e.g. "VLP-16 of A"."""
        if len(self.results) > len(self.sensors):
            return f"{self.baseline.sensor} of {self.baseline.run}"
        return self.baseline.sensor

    @property
    def has_yaw_or_pitch(self) -> bool:
        """Whether a mount is turned or tilted."""
        return any(result.mount.site.yaw_deg or result.mount.site.pitch_deg for result in self.results)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(dict.fromkeys(result.mount.sensor for result in self.results))

    @property
    def order(self) -> tuple[str, ...]:
        """Names of the sensors, best first."""
        by_score = sorted(self.results, key=lambda result: -result.mount.site.score)
        return tuple(dict.fromkeys(result.mount.sensor for result in by_score))

    @property
    def unpriced(self) -> tuple[str, ...]:
        """Names of the sensors whose cost is unknown."""
        return tuple(dict.fromkeys(result.mount.sensor for result in self.results if result.mount.cost is None))


def format_difference(difference: ScoreDifference, site: RankedSite) -> str:
    """Return a difference of scores with its standard error, e.g. "+3.1 ± 0.4" percentage points.

    Parameters
    ----------
    difference
        The difference.
    site
        One of the two sites, whose score has the unit: percentage points for a share, else that of the score.
    """
    label = site.by
    factor, digits = (100.0, 1) if label.is_share else (1.0, label.digits)
    text = f"{factor * difference.value:+z,.{digits}f}"
    if difference.se is not None:
        text += f" ± {factor * difference.se:,.{digits}f}"
    return text if difference.is_clear else f"~ {text}"


def difference_unit(site: RankedSite) -> str:
    """Return the unit of differences of the score by which a site is ranked."""
    if site.by.is_share:
        return "percentage points"
    return site.by.unit or f"units of {site.by.noun}"
