"""What came of it, for a reader who has not read the paper?

Steps: read the scores, the TPOG, the statics and ``run.json``; march the beams of the best and of the worst site once
more; draw (:mod:`pipeline.report.plan`); fill the template. ``report.html`` is one file that fetches nothing.

It is a function of the artefacts and of what ``run.json`` holds of the earlier stages, their costs included: no clock,
no path, no machine. A second run with the same costs writes the same bytes."""

from __future__ import annotations

import base64
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import SEPARABLE, Tpog, read_accuracy, read_scores, read_tpog
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.core.version import __version__
from pipeline.report import plan as figures
from pipeline.report.plan import Spot
from pipeline.scenario.models import Scenario
from pipeline.scoring import visibility
from pipeline.scoring.egvs import EntropyField
from pipeline.world.mesh import read_ply

NAME = "report"
ARTEFACTS = ("report.html",)
ACCURACY = ("accuracy.parquet", "accuracy.png")
"""Shown where an accuracy study of the same settings and files was made in the run's folder."""

LISTED, FIRST, LAST = 40, 30, 5
"""More than ``LISTED`` sites are shown as the first and the last of them."""

CLOSE = 0.01
"""Sites within this share of the best score are named beside it."""

_STAGES = ("traffic", "statics", "tpog", "scan", "score")
_UNSTABLE = ("sumo_seconds",)
"""What a stage says that another run says differently."""

_LEFT_OUT = (
    ("vehicles that hide one another", "moving_occlusion"),
    ("rain", "rain"),
    ("fog", "fog"),
    ("the weakening of a beam with distance", "range_limit"),
    ("leaves that let some light through", "foliage"),
    ("people on foot and on bicycles", "pedestrians_bicycles"),
    ("dirt and glare", ""),
)
"""What no plain scene models, and the effect that does."""

Row = dict[str, Any]


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """The artefacts by hash, what the earlier stages said, and what they cost, and the settings that are shown."""
    read = ["trajectories.parquet", "tpog.parquet", "statics.ply", "scores.parquet"]
    if scenario.scan.keep:
        read.append("scans.parquet")
    record = _record(out)
    more: dict[str, Any] = {}
    if not scenario.scan.keep:
        from pipeline.sensing import scanner as survey

        more = {"scan": survey.settings(scenario, out), "scan_files": survey.file_digests(scenario, out)}
    return {
        "settings": {"shown": _shown(scenario), "keep": scenario.scan.keep, **more},
        "costs": _costs(record),
        "files": {name: files.sha256_of(out / name) for name in (*read, *ACCURACY) if (out / name).is_file()},
        "said": {name: _said(record, name) for name in _STAGES},
    }


@dataclass(frozen=True)
class Study:
    """What ``egvs accuracy`` found: rows of ``accuracy.parquet`` that the page shows, and the figure in base 64."""

    rows: list[Row]
    tolerance: float
    figure: str

    @property
    def best(self) -> Row | None:
        """The recommended setting."""
        return next((row for row in self.rows if row["recommended"]), None)


def _accuracy(record: dict[str, Any], out: Path) -> Study | None:
    """A study of what the run ran on: its own setting, the reference, the front, the default; None where there is no
    such study."""
    table, figure = (out / name for name in ACCURACY)
    found = read_accuracy(table) if figure.is_file() else None
    if found is None or any(
        record.get("stages", {}).get(n, {}).get("inputs") != key for n, key in found[1]["stages"].items()
    ):
        return None
    rows = [
        r for r in found[0] if r["kind"] in ("scenario", "reference") or r["front"] or r["recommended"] or r["default"]
    ]
    return Study(rows, found[1]["tolerance"], base64.b64encode(figure.read_bytes()).decode("ascii"))


def _shown(scenario: Scenario) -> dict[str, Any]:
    return {
        "name": scenario.name,
        "description": scenario.description,
        "seed": scenario.seed,
        "roi": scenario.roi.model_dump(mode="json"),
        "frame_period_s": scenario.traffic.frame_period_s,
        "vehicles": scenario.traffic.vehicles,
        "gamma": repr(scenario.score.gamma),
        "effects": scenario.effects,
    }


def run(scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Write ``report.html``.

    Returns
    -------
    dict
        ``best`` and ``worst`` (names of sites), ``kilobytes``.
    """
    del jobs
    ranking = Ranking.of(read_scores(out / "scores.parquet").to_pylist(), out / "scores.parquet")
    tpog = read_tpog(out / "tpog.parquet")
    progress("artefacts read", 1, 3)
    drawn = _figures(scenario, out, ranking, tpog)
    progress("figures drawn", 2, 3)
    page = _page(scenario, ranking, tpog, drawn, _record(out), _accuracy(_record(out), out))
    files.write_text(out / ARTEFACTS[0], page)
    progress("page written", 3, 3)
    return {
        "best": ranking.rows[0]["site"],
        "worst": ranking.rows[-1]["site"],
        "kilobytes": round(len(page.encode("utf-8")) / 1000),
    }


# ---- the ranking


@dataclass(frozen=True)
class Ranking:
    """Sites by rank, those of equal rank in the order of the sites.

    Attributes
    ----------
    rows
        Rows of ``scores.parquet``.
    best
        Those of rank 1.
    close
        Those that follow within ``CLOSE`` of the best score.
    """

    rows: tuple[Row, ...]
    best: tuple[Row, ...]
    close: tuple[Row, ...]

    @classmethod
    def of(cls, scores: Sequence[Row], place: Path) -> Ranking:
        """From the rows of ``scores.parquet``; InputError when there are none."""
        if not scores:
            raise InputError(place, "holds no site", "at least one; run the score stage again")
        rows = tuple(sorted(scores, key=lambda row: int(row["rank"])))
        best = tuple(row for row in rows if row["rank"] == 1)
        near = (1 - CLOSE) * best[0]["egvs"]
        close = tuple(row for row in rows if row["rank"] > 1 and row["egvs"] >= near > 0)
        return cls(rows, best, close)

    @property
    def all_equal(self) -> bool:
        """Whether no site is better than another."""
        return len(self.best) == len(self.rows)

    @property
    def extremes(self) -> tuple[Row, ...]:
        """The best and the worst site; one where they score the same."""
        return self.rows[:1] if self.all_equal else (self.rows[0], self.rows[-1])

    @property
    def spots(self) -> list[Spot]:
        """As the figures want them."""
        return [Spot(*(row[name] for name in ("site", "x_m", "y_m", "z_m", "egvs", "rank"))) for row in self.rows]

    def of_best(self, row: Row) -> float:
        """A score as a share of the best one; 0 where that is 0."""
        top = self.best[0]["egvs"]
        return float(row["egvs"] / top) if top > 0 else 0.0


# ---- the figures


@dataclass(frozen=True)
class View:
    """What one site sees and misses: its row, both figures, and voxels with entropy that it sees, of all."""

    row: Row
    title: str
    seen: str
    missed: str
    voxels_seen: int
    voxels: int


@dataclass(frozen=True)
class Drawn:
    """The report's figures, and what stands in the legend of their footprints."""

    tpog: str
    sites: str
    views: tuple[View, ...]
    scale: str
    layers: tuple[figures.Layer, ...]


def _figures(scenario: Scenario, out: Path, ranking: Ranking, tpog: Tpog) -> Drawn:
    grid, spots = tpog.grid, ranking.spots
    world, _ = read_ply(out / "statics.ply")
    layers = figures.footprints(world, figures.extent(grid, spots))
    occupied = tpog.counts.sum(axis=2) / tpog.frames
    top = ranking.best[0]
    field = EntropyField.of(tpog.counts, tpog.frames, grid)
    tpog_figure, scale = "", ""
    views: tuple[View, ...] = ()
    if tpog.counts.any():
        busiest = np.unravel_index(int(occupied.argmax()), occupied.shape)
        x, y = (o + (i + 0.5) * grid.voxel_m for o, i in zip(grid.origin_m, busiest, strict=False))
        alt = (
            f"Occupancy of the region of interest by traffic, seen from above: {np.count_nonzero(occupied) / occupied.size:.0%} of "
            f"its area is used by vehicles; the busiest place is near x = {x:.0f} m, y = {y:.0f} m."
        )
        label = "Occupied voxels in the column, on average: probabilities summed along z"
        tpog_figure = figures.occupancy(grid, occupied, label, layers, spots, alt)
    if len(field.cells):
        views, scale = _views(scenario, out, ranking, field, layers)
    alt = (
        f"Map of {len(spots)} candidate sites by score. Best: {top['site']} at x = {top['x_m']:g} m, y = {top['y_m']:g} m; "
        f"last: {ranking.rows[-1]['site']} at x = {ranking.rows[-1]['x_m']:g} m, y = {ranking.rows[-1]['y_m']:g} m."
    )
    return Drawn(tpog_figure, figures.site_map(grid, occupied, layers, spots, alt), views, scale, layers)


def _views(
    scenario: Scenario, out: Path, ranking: Ranking, field: EntropyField, layers: Sequence[figures.Layer]
) -> tuple[tuple[View, ...], str]:
    """What the best and the worst site see and miss, and the colour scale of these figures."""
    names = [row["site"] for row in ranking.extremes]
    spots = {spot.site: spot for spot in ranking.spots if spot.site in names}
    peak = float(_columns(field, np.ones(len(field.cells), dtype=np.bool_)).max())
    box = figures.extent(field.grid, list(spots.values()))
    found: dict[str, View] = {}
    for name, hits in visibility.hits_of(scenario, out, field.grid, names):
        place = names.index(name)
        stand = figures.Stand(spots[name], hits > 0, layers, box)
        found[name] = _view(ranking.extremes[place], field, peak, stand, place, len(ranking.rows) == 1)
    return tuple(found[name] for name in names), figures.scale(peak, "Entropy in the column (bit)")


def _view(row: Row, field: EntropyField, peak: float, stand: figures.Stand, place: int, alone: bool) -> View:
    crossed = stand.crossed.ravel()[field.cells]
    drawn: dict[str, str] = {}
    for word, which, share in (("seen", crossed, row["entropy_seen"]), ("missed", ~crossed, 1 - row["entropy_seen"])):
        alt = f"From above: the {share:.1%} of the entropy {word} by {row['site']} at x = {row['x_m']:g} m, y = {row['y_m']:g} m."
        drawn[word] = figures.view(field.grid, _columns(field, which), peak, stand, f"view-{place}-{word}", alt)
    title = "Last site" if place else "The site" if alone else "Best site"
    return View(row, title, drawn["seen"], drawn["missed"], int(crossed.sum()), len(crossed))


def _columns(field: EntropyField, which: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Entropy summed along z over some of the voxels, (nx, ny) bits; added up in the order of the voxels."""
    nx, ny, nz = field.grid.shape
    summed = np.bincount(field.cells[which] // nz, weights=field.per_cell_bit[which], minlength=nx * ny)
    return summed.astype(np.float64).reshape(nx, ny)


# ---- the page


def _page(
    scenario: Scenario, ranking: Ranking, tpog: Tpog, drawn: Drawn, record: dict[str, Any], study: Study | None
) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"svg": Markup, "share": _share, "whole": lambda value: f"{value:,.0f}", "plain": _plain}
    rows, effects = ranking.rows, _effects(scenario)
    shortened = len(rows) > LISTED
    return environment.get_template("report.html.j2").render(
        study=study,
        unsure="egvs_se" in rows[0],
        separable=SEPARABLE,
        scenario=scenario,
        ranking=ranking,
        first=rows[:FIRST] if shortened else rows,
        last=rows[-LAST:] if shortened else (),
        hidden=len(rows) - FIRST - LAST if shortened else 0,
        shared={rank for rank, count in Counter(row["rank"] for row in rows).items() if count > 1},
        headline=_headline(ranking, tpog),
        nearest=_nearest(ranking),
        limit_share=_limit_share(rows[0]),
        tpog=tpog,
        busy=bool(tpog.counts.any()),
        drawn=drawn,
        crowded=figures.is_crowded(ranking.spots),
        rings=figures.has_rings(ranking.spots),
        style=Markup(figures.STYLE),
        gamma="∞" if math.isinf(scenario.score.gamma) else f"{scenario.score.gamma:g}",
        uncapped=math.isinf(scenario.score.gamma),
        lasts=_duration(tpog.frames * scenario.traffic.frame_period_s),
        said={name: _said(record, name) for name in _STAGES},
        costs=_costs(record),
        total_s=math.fsum(cost["seconds"] or 0.0 for cost in _costs(record)),
        artefacts=[(a, digest) for name in _STAGES for a, digest in _stage(record, name).get("artefacts", {}).items()],
        effects=effects,
        left_out=[what for what, effect in _LEFT_OUT if effect not in effects],
        version=__version__,
    )


def _effects(scenario: Scenario) -> list[str]:
    """Names of the effects that the scenario names."""
    return list(scenario.effects)


def _headline(ranking: Ranking, tpog: Tpog) -> str:
    """The outcome in one sentence."""
    best, others = ranking.best, len(ranking.rows) - 1
    top = best[0]
    if not tpog.counts.any():
        return "No traffic in the region: the sites cannot be ranked"
    if not top["egvs"] > 0:
        return "No site sees anything of the traffic" if others else f"{top['site']} sees nothing of the traffic"
    sees = f"sees {_share(top['entropy_seen'])} of the traffic’s uncertainty"
    if not others:
        return f"{top['site']}, the only site, {sees}"
    if ranking.all_equal:
        return (
            f"All {len(best)} sites score the same: each {sees}"
            if _alike(best)
            else f"All {len(best)} sites score the same"
        )
    if len(best) > 1:
        names = (
            ", ".join(row["site"] for row in best[:-1])
            if len(best) <= 4
            else f"{top['site']} and {len(best) - 2} others"
        )
        return f"{names} and {best[-1]['site']} share the first place of {others + 1}: {top['site']} {sees}"
    return f"{top['site']} is the best of {others + 1} sites: it {sees}"


def _alike(rows: Sequence[Row]) -> bool:
    return len({row["entropy_seen"] for row in rows}) == 1


def _nearest(ranking: Ranking) -> str:
    """By how much the best leads."""
    if ranking.all_equal or not ranking.best[0]["egvs"] > 0:
        return ""
    second = ranking.rows[len(ranking.best)]
    behind = 1 - ranking.of_best(second)
    lead = f"{behind:.1%}" if behind >= 0.0005 else "less than 0.1%"
    text = f"It leads {second['site']}, the next, by {lead} of its score." if len(ranking.best) == 1 else (
        f"They lead {second['site']}, the next, by {lead} of their score.")  # fmt: skip
    if ranking.best[0].get("beats_next", 1.0) < SEPARABLE:
        text += " With this much traffic the two cannot be told apart."
    if len(ranking.close) > 1:
        names = ", ".join(row["site"] for row in ranking.close[:4])
        more = f" and {len(ranking.close) - 4} more" if len(ranking.close) > 4 else ""
        text += f" Within {CLOSE:.0%} of the best are {len(ranking.close)} others: {names}{more}."
    return text


def _limit_share(row: Row) -> float | None:
    """The best score as a share of what no site could exceed."""
    limit = row["egvs_limit"]
    return row["egvs"] / limit if limit > 0 and math.isfinite(limit) else None


def _costs(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Seconds and peak memory of each stage; None where they are not known."""
    found = [(name, _stage(record, name).get("cost") or {}) for name in _STAGES]
    longest = max((c["seconds"] for _, c in found if "seconds" in c), default=0.0)
    return [
        {
            "stage": name,
            "seconds": cost.get("seconds"),
            "peak_mb": cost.get("peak_mb"),
            "part": cost.get("seconds", 0.0) / longest if longest > 0 else 0.0,
        }
        for name, cost in found
    ]


def _record(out: Path) -> dict[str, Any]:
    """What ``run.json`` holds; nothing when the stages ran without one."""
    path = out / "run.json"
    if not path.is_file():
        return {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not a run's record ({error})", "remove it and run again") from None
    return record if isinstance(record, dict) else {}


def _stage(record: dict[str, Any], name: str) -> dict[str, Any]:
    stage: dict[str, Any] = record.get("stages", {}).get(name) or {}
    return stage


def _said(record: dict[str, Any], name: str) -> dict[str, Any]:
    """What a stage said of its outcome, without what another run would say differently."""
    return {key: value for key, value in (_stage(record, name).get("summary") or {}).items() if key not in _UNSTABLE}


def _share(value: float) -> str:
    return f"{value:.1%}"


def _plain(value: float) -> str:
    """A number as a person would write it."""
    return f"{value:,.2f}".rstrip("0").rstrip(".")


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{seconds:g} s"
    hours, minutes = divmod(minutes, 60)
    return " ".join(f"{n} {unit}" for n, unit in ((hours, "h"), (minutes, "min"), (rest, "s")) if n)
