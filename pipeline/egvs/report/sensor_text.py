"""Sentences about a comparison of sensors, for the report and the terminal."""

from __future__ import annotations

from collections.abc import Iterable

from egvs.results.labels import SCORE_LABELS
from egvs.results.levels import MIN_NOTICED_LEAD
from egvs.results.sensors import SensorComparison, difference_unit
from egvs.results.study_results import STUDY
from egvs.scenario.score_config import DEFAULT_SCORE

SENSOR_EVIDENCE = (
    "How far to trust this: in simulation, at six held-out junctions with twelve sensors, the mean of cluster and "
    "pointpillars ranked sites nearly as three detectors do (rank correlation {rho[0]:.2f} to {rho[1]:.2f}). But the "
    "first of a ranking lost up to {loss_points} points of AP, and {largest_loss_points} once; shares found with "
    "{underrated_sensors[0]} and {underrated_sensors[1]} are {underrated_points[0]} to {underrated_points[1]} points "
    "higher than expected. Do not decide between sensors by less than about 10 points, nor by the cost of one more "
    "point. See docs/validity.md."
).format(**dict(STUDY.larger_study))
"""What is known about rankings of sensors by the recommended score (docs/validity.md)."""

_NO_EVIDENCE = (
    "How far to trust this: whether {} ranks different sensors as detectors do was not measured; docs/validity.md has "
    "a measurement for {}."
)

_RANGE_NOTE = (
    "Ranges on dark vehicles are not modelled: sensors with a short rated range look better than they are. Try --set "
    "effects.range_limit={}."
)


def range_note(sensors: Iterable[str], *, is_modelled: bool) -> str:
    """Return a sentence where sensors are compared without their range on dark vehicles; empty otherwise.

    Parameters
    ----------
    sensors
        Names of the sensors.
    is_modelled
        Whether the effect ``range_limit`` is enabled in all runs.
    """
    if is_modelled or len(set(sensors)) < 2:
        return ""
    return _RANGE_NOTE


def explain_differences(comparison: SensorComparison) -> str:
    """Return what the differences between sensors, and the cost of one more point, refer to."""
    kind = "the cheapest" if comparison.has_costs else "which finds least"
    unpriced = ""
    if comparison.has_costs and comparison.unpriced:
        kind = "the cheapest with a known cost"
        unpriced = f" Without a known cost: {', '.join(comparison.unpriced)}."
    return (
        f"Differences from {comparison.baseline_name} ({kind}) are in {difference_unit(comparison.baseline.site)}, "
        f"± their standard error; ~ it is not clear which is better.{unpriced}"
    )


def noticed_preference(comparison: SensorComparison) -> str:
    """Return a sentence if people would notice clearly more with another sensor than the best one; else empty."""
    sites = [result.mount.site for result in comparison.results]
    if sites[0].by.name != DEFAULT_SCORE:
        return ""
    best = max(sites, key=lambda site: site.score)
    shares = [(site.noticed, site) for site in sites if site.noticed is not None]
    if len(shares) < len(sites) or best.noticed is None:
        return ""
    most, other = max(shares, key=lambda pair: pair[0].value)
    if other.sensor == best.sensor or most.value - best.noticed.value < MIN_NOTICED_LEAD:
        return ""
    return (
        f"People would notice more with {other.sensor} ({most.cell}) than with {best.sensor} ({best.noticed.cell}); "
        "the differences above are of what detectors should find."
    )


def describe_evidence(comparison: SensorComparison) -> str:
    """Return what is known about rankings of sensors by the score that ranks."""
    by = comparison.baseline.site.by
    if by.name == DEFAULT_SCORE:
        return SENSOR_EVIDENCE
    return _NO_EVIDENCE.format(by.noun, SCORE_LABELS[DEFAULT_SCORE].noun)


def costs_option(sensors: Iterable[str]) -> str:
    """Return the option that sets the costs of sensors, with a word in place of each price."""
    prices = ", ".join(f'"{name}" = PRICE' for name in sensors)
    return f"--set 'costs.sensor={{{prices}}}'"
