"""The ranking of the sites in each period, side by side with that of the mix."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.artefacts import tables
from pipeline.artefacts.readers import read_periods, read_scores

PERIOD_SCORES = "scores_by_period.parquet"


@dataclass(frozen=True)
class InPeriod:
    """A site in one period: its rank, and its score, the one that ranks, as a share of the best there; 0 where that is
    0."""

    rank: int
    of_best: float


@dataclass(frozen=True)
class PeriodRanking:
    """Sites by rank in the mix, and each of them in every period.

    ``shares`` are the periods' weights in the mix, adding up to 1; ``frames`` those recorded in all of them.
    """

    periods: tuple[str, ...]
    shares: tuple[float, ...]
    frames: int
    sites: tuple[tuple[str, int, tuple[InPeriod, ...]], ...]

    @classmethod
    def read(cls, folder: Path) -> PeriodRanking | None:
        """From a run's folder; None where its traffic has no periods."""
        if not (folder / PERIOD_SCORES).is_file():
            return None
        periods = read_periods(folder / "tpog.parquet")
        table, about = tables.read(folder / PERIOD_SCORES, "scores_by_period")
        rows, by = table.to_pylist(), about.get("rank_by", "egvs")
        most: dict[str, float] = {}
        for row in rows:
            most[row["period"]] = max(most.get(row["period"], 0.0), row[by])
        of_site: dict[str, list[InPeriod]] = {}
        for row in rows:
            best = most[row["period"]]
            of_best = row[by] / best if best > 0 else 0.0
            of_site.setdefault(row["site"], []).append(InPeriod(row["rank"], of_best))
        mix = sorted(read_scores(folder / "scores.parquet").to_pylist(), key=lambda row: int(row["rank"]))
        weight = sum(period.weight for period in periods)
        return cls(
            tuple(period.name for period in periods),
            tuple(period.weight / weight for period in periods),
            sum(period.frames for period in periods),
            tuple((row["site"], row["rank"], tuple(of_site[row["site"]])) for row in mix),
        )
