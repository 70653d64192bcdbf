"""Rules for names: those that differ only in case, accents or invisible characters are often meant to be one.

Names are compared exactly everywhere, so ``Pole_1`` and ``pole_1`` are two sites. Names that differ only in the Unicode
of accents, or in invisible characters, look the same in every table, so they are an error; names that differ only in
case are a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

from egvs.core.errors import Diagnostic
from egvs.core.wording import list_first
from egvs.scenario.fields import same_name, similar_names
from egvs.scenario.model import SCENARIO_FILE
from egvs.scoring import zones
from egvs.stages.inputs import CheckInputs, ErrorCollector

MAX_LISTED_NAMES = 3


def check_similar_names(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report sites, sensors, kinds of vehicles and zones whose names differ only in case or accents."""
    scenario = inputs.scenario
    periods = scenario.by_period().values()
    yield from compare_names((site.name for site in inputs.sites), scenario.sites.file or "sites", "sites")
    yield from compare_names(scenario.sensors, f"{SCENARIO_FILE}: sensors", "sensors")
    kinds = dict.fromkeys(kind.name for period in periods for kind in period.traffic.kinds)
    yield from compare_names(kinds, f"{SCENARIO_FILE}: traffic.kinds", "kinds")
    for key, table in (
        (zones.WEIGHTS_KEY, scenario.score.weights.zones),
        (zones.PLACEMENT_KEY, scenario.placement.zones),
    ):
        yield from compare_names(table, f"{SCENARIO_FILE}: {key}", "zones")
    errors = ErrorCollector()  # the error of a file is reported where it is read first
    reported = errors.attempt("zones", partial(zones.reported_zones, scenario))
    yield from compare_names(reported or (), f"{SCENARIO_FILE}: {zones.REPORTED_KEY}", "zones")


def compare_names(names: Iterable[str], where: str, noun: str) -> Iterator[Diagnostic]:
    """Report names that differ only in what nobody sees, an error, or in case, a warning.

    Parameters
    ----------
    names
        The names.
    where
        File or key, for messages.
    noun
        What has these names, plural.
    """
    pairs = list(similar_names(names))
    unseen = "in the Unicode of accents or in invisible characters"
    for is_error, difference in ((True, unseen), (False, "in upper and lower case")):
        listed = [
            f"{one!a} and {other!a}" if is_error else f"{one} and {other}"
            for one, other in pairs
            if (same_name(one) == same_name(other)) == is_error
        ]
        if listed:
            problem = f"these {noun} differ only {difference}: {list_first(listed, MAX_LISTED_NAMES)}"
            hint = "Write each name in one way; if they are different, choose names that differ in more."
            yield Diagnostic("similar names", where, problem, hint, is_error)
