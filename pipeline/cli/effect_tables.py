"""Tables of effects: which exist, which a scenario calls for, what each costs and changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from pipeline.cli.terminal import NARROW, console

if TYPE_CHECKING:
    from pipeline.studies.ablation import Change
    from pipeline.studies.effect_overview import Call, Price


def print_effects(calls: Sequence[Call], prices: Mapping[str, Price] | None = None) -> None:
    """Effects, whether they are on, and why; what each costs and changes, where a study says so."""
    out = console(160, soft_wrap=False)
    table, is_wide = Table(box=None, pad_edge=False), out.width >= NARROW
    names = ["effect", *(("acts in", "kind") if is_wide else ()), "state", "why"]
    names += ["costs", "changes"] if prices is not None else []
    names += ["source"] if is_wide else []
    for name in names:
        table.add_column(name, overflow="fold", no_wrap=name in ("costs", "state"))
    for call in calls:
        cells = [call.name, *((call.stage, call.kind) if is_wide else ()), call.state, call.why]
        cells += _price(prices.get(call.name)) if prices is not None else ()
        table.add_row(*cells, *((call.source,) if is_wide else ()))
    out.print(table)


def _price(price: Price | None) -> tuple[str, str]:
    if price is None:
        return "", ""
    best = "the same best site" if price.regret == 0 else f"another best site, regret {price.regret:.2%}"
    return f"{price.seconds:+.2f} s", f"scores by up to {price.change:.1%}; {best}; tau {price.tau:.2f}"


def print_ablation(changes: Sequence[Change]) -> None:
    """What each effect changes: scores against the plain scene (the first), and ranks where they differ."""
    plain, others = changes[0], changes[1:]
    table = Table(
        box=None, pad_edge=False, title="change of each site's score against the plain scene (rank, where it changes)"
    )
    table.add_column("site")
    table.add_column("plain, bit", justify="right")
    for change in others:
        table.add_column(change.effect, justify="right")
    for row, site in enumerate(plain.sites):
        cells = (_changed(plain, change, row) for change in others)
        table.add_row(site, f"{plain.scores[row]:.1f} ({plain.ranks[row]})", *cells)
    table.add_row("seconds", f"{plain.seconds:.2f}", *(f"{change.seconds:.2f}" for change in others))
    console(160, soft_wrap=False).print(table)


def _changed(plain: Change, change: Change, row: int) -> str:
    """How one effect changes the score of the site in a row, and its rank."""
    score, rank = plain.scores[row], plain.ranks[row]
    part = 100 * (change.scores[row] / score - 1) if score else float("nan")
    return f"{part:+.2f} %" + (f" ({rank} to {change.ranks[row]})" if change.ranks[row] != rank else "")
