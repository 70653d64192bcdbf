"""Tables of what there is: sensors, effects and what they change, the store."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from pipeline.cli.terminal import NARROW, console, table

if TYPE_CHECKING:
    from pipeline.runs.store import Entry, Store
    from pipeline.sensing.sensors import Sensor
    from pipeline.studies.ablation import Change
    from pipeline.studies.effect_overview import Call, Price

_FILE_WIDTH = 160


def print_sensors(sensors: Iterable[Sensor]) -> None:
    """The sensors that need no table of the user's."""
    names = ("sensor", "rings", "elevation deg", "azimuth deg", "step deg", "beams", "range m", "rated m", "source")
    rows = table(names, left=("sensor", "source"), whole=[name for name in names if name != "source"])
    for s in sensors:
        around = s.azimuth_span_deg
        rows.add_row(
            s.name, str(s.channels) if s.channels else "-", "{:.4g} to {:.4g}".format(*s.elevation_span_deg),
            "all round" if around is None else "{:.4g} to {:.4g}".format(*around),
            "-" if s.azimuth_step_deg is None else f"{s.azimuth_step_deg:.6g}", str(s.beams), f"{s.range_m:g}",
            "-" if s.rated_range_m is None else f"{s.rated_range_m:g} at {s.rated_reflectivity:.0%}",
            s.source + (f". Assumed: {s.assumed}" if s.assumed else ""),
        )  # fmt: skip
    console(_FILE_WIDTH, soft_wrap=False).print(rows)


def print_effects(calls: Sequence[Call], prices: Mapping[str, Price] | None = None) -> None:
    """Effects, whether they are on, and why; what each costs and changes, where a study says so."""
    out = console(_FILE_WIDTH, soft_wrap=False)
    names = [
        "effect",
        "acts in",
        "kind",
        "state",
        "why",
        *(["expected change"] if any(call.change for call in calls) else []),
        *(["costs", "changes"] if prices is not None else []),
        "source",
    ]
    if out.width < NARROW:
        names = [name for name in names if name not in ("acts in", "kind", "source")]
    rows = table(names, left=names, whole=("costs", "state"))
    for call in calls:
        costs, changes = _price((prices or {}).get(call.name))
        cells = {"effect": call.name, "acts in": call.stage, "kind": call.kind, "state": call.state, "why": call.why,
                 "expected change": call.change, "costs": costs, "changes": changes, "source": call.source}  # fmt: skip
        rows.add_row(*(cells[name] for name in names))
    out.print(rows)


def _price(price: Price | None) -> tuple[str, str]:
    if price is None:
        return "", ""
    best = "the same best site" if price.regret == 0 else f"another best site, regret {price.regret:.2%}"
    return f"{price.seconds:+.2f} s", f"scores by up to {price.change:.1%}; {best}; tau {price.tau:.2f}"


def print_ablation(changes: Sequence[Change]) -> None:
    """What each effect changes: scores against the plain scene (the first), and ranks where they differ."""
    plain, others = changes[0], changes[1:]
    rows = table(["site", "plain, bit", *(change.effect for change in others)], left=("site",), fold=False)
    rows.title = "change of each site's score against the plain scene (rank, where it changes)"
    for i, site in enumerate(plain.sites):
        cells = (_changed(plain, change, i) for change in others)
        rows.add_row(site, f"{plain.scores[i]:.1f} ({plain.ranks[i]})", *cells)
    rows.add_row("seconds", *(f"{change.seconds:.2f}" for change in changes))
    console(_FILE_WIDTH, soft_wrap=False).print(rows)


def _changed(plain: Change, change: Change, i: int) -> str:
    """How one effect changes the score of the site in row ``i``, and its rank."""
    score, rank = plain.scores[i], plain.ranks[i]
    part = 100 * (change.scores[i] / score - 1) if score else float("nan")
    return f"{part:+.2f} %" + (f" ({rank} to {change.ranks[i]})" if change.ranks[i] != rank else "")


def print_store(store: Store) -> None:
    """What is kept: all entries, the one used last first; their total and its bound."""
    out = console(120)
    if store.folder is None:
        out.print("EGVS_STORE is empty: nothing is kept")
        return
    entries, now = store.entries(), time.time()
    rows = table(("stage", "key", "size", "age", "last used"), left=("stage", "key"), fold=False)
    for entry in entries:
        age, rest = _duration(now - entry.created), _duration(now - entry.last_used)
        rows.add_row(entry.stage, entry.key[:12], _size(entry.bytes), age, f"{rest} ago")
    out.print(rows)
    out.print(f"{store.folder}: {_total(entries)}, of at most {_size(store.bound_bytes)}")


def print_removed(store: Store, removed: list[Entry]) -> None:
    """What was removed from the store, and what is left."""
    print(f"{store.folder}: removed {_total(removed)}; {_total(store.entries())} are left")


def _total(entries: list[Entry]) -> str:
    return f"{len(entries)} entries, {_size(sum(entry.bytes for entry in entries))}"


def _size(size: float) -> str:
    unit, least = next(((u, n) for u, n in (("T", 1e12), ("G", 1e9), ("M", 1e6), ("K", 1e3)) if size >= n), ("", 1.0))
    return f"{size / least:.3g} {unit}B"


def _duration(seconds: float) -> str:
    for unit, least in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= least:
            return f"{seconds / least:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"
