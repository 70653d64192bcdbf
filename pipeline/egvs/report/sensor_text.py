"""Sentences about a comparison of sensors, for the report and the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.core.wording import by_number, format_percent
from egvs.results.labels import SCORE_LABELS, join_names
from egvs.results.levels import MIN_NOTICED_LEAD, DetectionLevel, GroupLevel
from egvs.results.ranking import RankedSite
from egvs.results.sensors import SensorComparison, difference_unit
from egvs.results.study_results import STUDY
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.sensors.return_model import REFLECTIVITY_INTERVAL
from egvs.sensors.sensor import scenario_sensor

_ADVICE = "Do not choose between real sensors by less than about 10 points."

SENSOR_EVIDENCE = (
    "How far to trust this: in simulation without losses of returns, at six held-out junctions with twelve sensors, "
    "the mean of cluster and pointpillars, before their correction for streets, ranked sites nearly as three detectors "
    "do (rank correlation {rho[0]:.2f} to {rho[1]:.2f}; after it {corrected[0]:.2f} to {corrected[1]:.2f} at three of "
    "the six). But the first of a ranking lost up to {loss_points} points of AP, and {largest_loss_points} once; "
    "shares found with {underrated_sensors[0]} and {underrated_sensors[1]} are {underrated_points[0]} to "
    "{underrated_points[1]} points higher than expected. {advice} See docs/validity.md."
).format(advice=_ADVICE, **dict(STUDY.larger_study), corrected=STUDY.street_levels.rho_in_larger_study)
"""What is known about rankings of sensors by the recommended score (docs/validity.md)."""

_NO_EVIDENCE = (
    "How far to trust this: whether {} ranks different sensors as detectors do was not measured; docs/validity.md has "
    "a measurement for {}."
)

_RANGE_NOTE = (
    "Losses of returns are not simulated for every sensor: a sensor without them looks better than it is. Enter the "
    "rated range of user-defined sensors, and leave out effects.range_limit = false."
)

LOSSES_EVIDENCE = (
    "Losses of returns (reflectivity 0.03, softness 1, dropout 0.05) were fitted on two units, an OS1-64 and a "
    "Pandar64, at one junction each: with them, simulated points on cars are 0.92 and 1.08 times the measured ones, "
    "without them 2.96 and 1.15 times. No other sensor was measured, and ranges at 10 % are the makers'. See "
    "docs/certainty.md."
)
"""What is known about losses of returns."""

_INTERVAL_SENTENCE = "± contains the interval of the reflectivity, 0.03 to 0.06, but no error of a maker's rated range."

_NO_INTERVAL_SENTENCE = (
    "± does not contain the interval of the reflectivity, 0.03 to 0.06: egvs compare SCENARIO --sensors adds it."
)


def describe_order(comparison: SensorComparison) -> str:
    """Return whether the order of the sensors is the same at both ends of the interval of the reflectivity, or empty.

    Empty where it is unknown.
    """
    order, at_high = comparison.order, comparison.order_at_high_reflectivity
    if not at_high:
        return ""
    low, high = REFLECTIVITY_INTERVAL
    if at_high == order:
        return f"From {low:g} to {high:g}, the order of the sensors stays the same: {', '.join(order)}."
    return f"At {high:g}, the order of the sensors is {', '.join(at_high)}; at {low:g}, it is {', '.join(order)}."


def sensors_without_losses(scenario: Scenario, sensors: Iterable[str]) -> list[str]:
    """Return which sensors lose no returns in the simulation, although they may in reality; each once.

    All with ``effects.range_limit = false``; else those without a rated range.
    """
    names = list(dict.fromkeys(sensors))
    if scenario.effects.range_limit is not None:
        return names if scenario.effects.range_limit is False else []
    return [name for name in names if scenario_sensor(name, scenario, "sensors").rated_range_m is None]


def has_losses(scenario: Scenario, sensors: Iterable[str]) -> bool:
    """Return whether losses of returns of some sensors are simulated, or cannot change the result."""
    return not sensors_without_losses(scenario, sensors)


def detection_level(
    scenario: Scenario, detectors: Sequence[str], sensor: str, groups: Sequence[GroupLevel]
) -> DetectionLevel:
    """Return what is known of the share that detectors find from a site.

    Parameters
    ----------
    scenario
        The scenario of the run.
    detectors
        The detectors that the share is the mean over.
    sensor
        The sensor of the site.
    groups
        The groups of road users, from :func:`egvs.results.levels.read_levels`.
    """
    return DetectionLevel(tuple(detectors), tuple(groups), has_losses(scenario, [sensor]))


def plan_level(scenario: Scenario, sensors: Sequence[str], groups: Sequence[GroupLevel]) -> DetectionLevel:
    """Return what is known of the share that detectors find from the sensors of a plan (:func:`detection_level`)."""
    return DetectionLevel(tuple(scenario.score.ranking_detectors), tuple(groups), has_losses(scenario, sensors))


def upper_limit_note(scenario: Scenario, sensors: Iterable[str]) -> str:
    """Return a sentence if what people would notice is an upper limit, as sensors lose no returns; else empty.

    Parameters
    ----------
    scenario
        The scenario of the run.
    sensors
        Names of the sensors for which it is stated what people would notice.
    """
    names = sensors_without_losses(scenario, sensors)
    if not names:
        return ""
    reason = "effects.range_limit = false"
    if scenario.effects.range_limit is not False:
        reason = f"{by_number(len(names), 'it has', 'they have')} no rated range"
    return (
        f"Losses of returns are not simulated for {join_names(names)} ({reason}), but the curves of what people notice "
        "are for points with losses: read that share as an upper limit. The level of corrected detectors is unknown "
        "without losses, too."
    )


def range_note(sensors: Iterable[str], *, is_modelled: bool) -> str:
    """Return a sentence where sensors are compared without losses of returns; empty otherwise.

    Parameters
    ----------
    sensors
        Names of the sensors.
    is_modelled
        Whether losses are simulated in all runs, or cannot change them.
    """
    if is_modelled or len(set(sensors)) < 2:
        return ""
    return _RANGE_NOTE


def explain_differences(reference: str, site: RankedSite) -> str:
    """Return what differences from a run or a sensor are; ``site`` is one of the compared sites."""
    probability = format_percent(DISTINCT_PROBABILITY, 0)
    return (
        f"Differences from {reference} are in {difference_unit(site)}, ± their standard error; ~ it is not clear which "
        f"is better (probability below {probability})."
    )


def explain_sensor_differences(comparison: SensorComparison) -> str:
    """Return what the differences between sensors refer to."""
    kind = "the cheapest" if comparison.has_costs else "which finds least"
    unpriced = ""
    if comparison.has_costs and comparison.unpriced:
        kind = "the cheapest with a known cost"
        unpriced = f" Without a known cost: {', '.join(comparison.unpriced)}."
    return f"{explain_differences(f'{comparison.baseline_name} ({kind})', comparison.baseline.site)}{unpriced}"


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


def describe_trust(comparison: SensorComparison) -> str:
    """Return in a line or two how far to trust a comparison of sensors; :func:`describe_evidence` says why."""
    by = comparison.baseline.site.by
    text = f"Whether {by.noun} ranks different sensors as detectors do was not measured."
    if by.name == DEFAULT_SCORE:
        text = _ADVICE
    interval = _INTERVAL_SENTENCE if comparison.has_loss_interval else _NO_INTERVAL_SENTENCE
    return f"{text} {interval} See docs/validity.md and docs/certainty.md."


def costs_option(sensors: Iterable[str]) -> str:
    """Return the option that sets the costs of sensors, with a word in place of each price."""
    prices = ", ".join(f'"{name}" = PRICE' for name in sensors)
    return f"--set 'costs.sensor={{{prices}}}'"
