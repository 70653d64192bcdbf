"""Join the summaries of simulations that differ in their seeds only to that of their traffic.

Keys are those of a single simulation: numbers of events add up, means are weighted by their numbers of vehicles, and
extremes are those of all simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from egvs.core.errors import WARNINGS_KEY
from egvs.stages.base import Summary

_TOTALS = (
    "frames", "rows", "overlapping_pairs", "frames_with_overlap", "overlapping_pairs_in_roi", "collisions", "teleports",
)  # fmt: skip
_MEANS_DIGITS = 4


def merge_seed_summaries(summaries: Sequence[Summary], seeds: Sequence[int]) -> Summary:
    """Return the summary of all simulations of one traffic.

    Parameters
    ----------
    summaries
        Summaries of the traffic stage, one for each simulation.
    seeds
        Their seeds.

    Returns
    -------
    dict
        The same keys as those of one simulation; ``flags`` by number of the simulation (from 1), and ``seeds``.
        Effects report the values of each simulation in a list where these differ.
    """
    first = summaries[0]
    merged: Summary = {"seeds": list(seeds)}
    for key in dict.fromkeys(key for summary in summaries for key in summary):
        values = [summary[key] for summary in summaries if key in summary]
        merge = _MERGES.get(key)
        if merge is not None:
            merged[key] = merge(values)
        elif key in ("mean_speed_m_s", "share_standing"):
            merged[key] = _weighted_mean(summaries, key)
        else:
            merged[key] = values[0] if all(value == values[0] for value in values) else values
    merged["flags"] = {str(number): summary.get("flags") for number, summary in enumerate(summaries, start=1)}
    if WARNINGS_KEY in first:
        merged[WARNINGS_KEY] = _merge_warnings([summary.get(WARNINGS_KEY, []) for summary in summaries])
    return merged


def _weighted_mean(summaries: Sequence[Summary], key: str) -> float:
    rows: int = sum(summary["rows"] for summary in summaries)
    total: float = sum(summary[key] * summary["rows"] for summary in summaries)
    return round(total / max(rows, 1), _MEANS_DIGITS)


def _merge_numbers(values: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Join numbers of vehicles at a time; ``mean`` only of kinds, whose simulations have equal numbers of frames."""
    merged = {
        "fewest": min(value["fewest"] for value in values),
        "most": max(value["most"] for value in values),
        "different": sum(value["different"] for value in values),
    }
    if "mean" in values[0]:
        merged["mean"] = round(sum(value["mean"] for value in values) / len(values), 3)
    return merged


def _merge_uncounted(values: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Join the numbers of each kind that is no vehicle; a kind may be missing in a simulation."""
    pairs: dict[str, int] = {}
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for value in values:
        for kind, numbers in value.items():
            if kind == "overlapping_pairs":
                for kinds, count in numbers.items():
                    pairs[kinds] = pairs.get(kinds, 0) + count
            else:
                by_kind.setdefault(kind, []).append(numbers)
    merged = {}
    for kind, numbers in sorted(by_kind.items()):
        absent = [{"fewest": 0, "most": 0, "mean": 0.0, "different": 0}] * (len(values) - len(numbers))
        merged[kind] = _merge_numbers([*numbers, *absent])
    return merged | {"overlapping_pairs": dict(sorted(pairs.items()))}


def _merge_counts(values: Sequence[Any]) -> list[dict[str, Any]]:
    """Return the fits of counts with the flow of all simulations, which last equally long."""
    from egvs.traffic.count_fit import geh

    merged = []
    for fits in zip(*values, strict=True):
        simulated_per_h = round(sum(fit["simulated_per_h"] for fit in fits) / len(fits), 1)
        fit = dict(fits[0]) | {"simulated_per_h": simulated_per_h}
        merged.append(fit | {"geh": round(geh(fit["counted_per_h"], simulated_per_h), 2)})
    return merged


def _merge_warnings(values: Sequence[list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return each warning once; one that not all simulations give names those that do."""
    keyed: dict[str, tuple[dict[str, Any], list[int]]] = {}
    for number, warnings in enumerate(values, start=1):
        for warning in warnings:
            keyed.setdefault(repr(sorted(warning.items())), (warning, []))[1].append(number)
    merged = []
    for warning, numbers in keyed.values():
        if len(numbers) == len(values):
            merged.append(warning)
            continue
        listed = ", ".join(map(str, numbers))
        merged.append({**warning, "where": f"{warning['where']} (simulation {listed} of {len(values)})"})
    return merged


def _sum_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(sum(known), 3) if known else None


def _max_known(values: Sequence[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _each_once(values: Sequence[list[Any]]) -> list[Any]:
    return list(dict.fromkeys(note for notes in values for note in notes))


_MERGES: dict[str, Callable[[Sequence[Any]], Any]] = {
    **dict.fromkeys(_TOTALS, sum),
    "vehicles": _merge_numbers,
    "longest_standing_s": max,
    "sumo_seconds": _sum_known,
    "sumo_peak_mb": _max_known,
    "beside_vehicles": _merge_uncounted,
    "notes": _each_once,
    "counts": _merge_counts,
}
