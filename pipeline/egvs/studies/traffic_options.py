"""Options of the traffic: SUMO's step, sublanes and routing; which can be tried, and which have no effect.

With another step, other sublanes or other routes, the random numbers of SUMO fall differently: the traffic is another
draw. So an option is judged as the scenario is, by what several seeds of it choose (:mod:`egvs.studies.decision`).
"""

from __future__ import annotations

from collections.abc import Iterator

from egvs.results.studies import APPROXIMATES, MEASURES
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig
from egvs.studies.study_settings import ROUTING_KNOB, SUBLANES_KNOB, Setting, SettingValues

_SUBLANES_KEY, _ROUTING_KEY, _STEP_KEY = "lateral_resolution_m", "reroute_at_departure", "step_s"


def traffic_option_settings(scenario: Scenario, values: SettingValues) -> Iterator[Setting]:
    """Yield other sublanes and other routing, where they have an effect.

    Parameters
    ----------
    scenario
        The scenario.
    values
        Values to try.
    """
    if scenario.is_recorded or not values.traffic_options:
        return
    traffic = scenario.traffic
    resolution_m, name = 0.0, "without sublanes"
    if traffic.lateral_resolution_m == 0.0:
        resolution_m = TrafficConfig.model_fields[_SUBLANES_KEY].default
        name = f"sublanes of {resolution_m:g} m"
    yield Setting(name, APPROXIMATES, SUBLANES_KNOB, (f"traffic.{_SUBLANES_KEY}={resolution_m}",))
    if not why_without_effect(scenario, _ROUTING_KEY):
        name = "routes on empty streets" if traffic.reroute_at_departure else "routes by traffic at departure"
        value = str(not traffic.reroute_at_departure).lower()
        yield Setting(name, MEASURES, ROUTING_KNOB, (f"traffic.{_ROUTING_KEY}={value}",))


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
    if traffic.is_finished:
        return "the traffic was recorded"
    if key != _ROUTING_KEY:
        return ""
    if traffic.sumocfg is not None:
        return "the SUMO configuration sets the routes"
    if traffic.routes:
        return "route files set the routes"
    if traffic.counts:
        return "counted traffic has routes of its own"
    return ""
