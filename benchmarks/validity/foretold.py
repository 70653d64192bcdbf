"""Does the score that is recommended foretell detection where nothing was learnt or chosen? The tables of F.

It came after A to E: learnt on the training junctions (``benchmarks/detectability``), so nothing is quoted for them. It
is compared with the EGVS at every setting that was tried, also with the one that is best at the very same sites, which
nobody can know beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from benchmarks.validity import low_models
from benchmarks.validity.agreement import HELD_OUT, TRAINING, WORDS, told
from benchmarks.validity.failures import COLUMNS, worst
from benchmarks.validity.pools import DEFAULT, Pools, Setting
from benchmarks.validity.record import Record, StudySite, measures_of
from benchmarks.validity.tables import Cell, Column, Table
from egvs.scoring.target_scores import DETECTORS
from egvs.validation.results import ScoreName
from egvs.validation.sweeps import POINT_COUNTS_NAME

RECOMMENDED = str(ScoreName("expected_detections", f'{{"detectors": "{"+".join(DETECTORS)}"}}'))
"""What is recommended: the mean chance over the detectors that have a model."""

LATER = ("seen_well", "expected_detections")
"""Scores that came after A to E were answered; they have no part in these."""

BETTER = Setting(2.0, DEFAULT.voxel_m, False)
"""What ``gamma = "auto"`` has at the default's voxels, chosen on training junctions."""

_KINDS: dict[str, Callable[[StudySite], bool]] = {
    "all": lambda site: True,
    "given": lambda site: site.is_given,
    "grid": lambda site: not site.is_given,
}


def before(records: Sequence[Record]) -> list[Record]:
    """What A to E rest on: the junctions and scores that were there then."""
    kept = [record for record in records if record.role in (TRAINING, HELD_OUT)]
    return [
        replace(its, scores={name: v for name, v in its.scores.items() if not name.startswith(LATER)}) for its in kept
    ]


def tables(records: Sequence[Record], detectors: Sequence[str]) -> Iterator[Table]:
    """F: a table of coefficients a detector, and the sites that the score ranks worst; nothing without that score."""
    held = [its for its in records if its.role != TRAINING and RECOMMENDED in its.scores]
    named = [name for name in detectors if name not in low_models.NAMES]
    pairs = [(name, [its for its in held if name in its.detections]) for name in named]
    for name, mine in ((name, its) for name, its in pairs if its):
        yield from (_coefficients(mine, name, measure) for measure in measures_of(name))
    if boxed := [(name, its) for name, its in pairs if its and name != POINT_COUNTS_NAME]:
        yield _every_score(boxed)
    for name, mine in ((name, its) for name, its in pairs if its):
        measure = measures_of(name)[0]
        rows = [row for record in mine for row in worst(record, name, measure, RECOMMENDED)]
        caption = (
            f"The sites whose rank by {RECOMMENDED} differs most from their rank by {WORDS[measure]} ({name}); columns"
            " as in E."
        )
        yield Table(f"F worst {name}", "F. Where the recommended score fails", caption, COLUMNS, rows)


def _coefficients(records: Sequence[Record], detector: str, measure: str) -> Table:
    rows: list[list[Cell]] = []
    for kind, wanted in _KINDS.items():
        some = [replace(record.only(wanted), role=HELD_OUT) for record in records]
        pools = Pools([its for its in some if its.detections[detector][measure].sites], detector)
        names = [name for name in pools.studies if name != HELD_OUT or len(pools.records) > 1]
        rows += [_row(pools, name, kind, measure) for name in names]
    head = [Column("junction"), Column("sites"), Column("number of sites", "whole")]
    head += [
        Column(its, "two") for its in ("recommended", "EGVS, gamma 10", "recommended minus gamma 10", "EGVS, gamma 2")
    ]
    head += [
        Column("best EGVS setting here"),
        Column("rho of that setting", "two"),
        Column("recommended minus that", "two"),
    ]
    caption = (
        f"Rho of the recommended score, {RECOMMENDED}, with {WORDS[measure]} ({detector}) at junctions that it was not"
        " trained on; next to it EGVS with 0.25 m voxels, and EGVS with the gamma, voxel size and moving occlusion that"
        " are best at the sites of that row."
    )
    return Table(f"F {detector} {measure}", "F. The recommended score", caption, head, rows)


def _every_score(boxed: Sequence[tuple[str, Sequence[Record]]]) -> Table:
    """What the program quotes where scores disagree: every score, over all these junctions together."""
    together = [Pools([replace(its, role=HELD_OUT) for its in records], name) for name, records in boxed]
    measures = [measures_of(pools.detector)[0] for pools in together]
    rho = [
        {score: pools.rho(HELD_OUT, score, measure) for score in pools.scores}
        for pools, measure in zip(together, measures, strict=True)
    ]
    names = [name for name in rho[0] if all(name in its for its in rho)]
    total = {name: sum(its[name].value for its in rho) for name in names}
    order = sorted(names, key=lambda name: math.inf if math.isnan(total[name]) else -total[name])
    rows: list[list[Cell]] = [[name, *(told(its[name]) for its in rho)] for name in order]
    head = [Column("score"), *(Column(pools.detector, "two") for pools in together)]
    caption = (
        f"Rho of every score with {WORDS[measures[0]]}, over all junctions that were not used for training, given and"
        " grid sites together."
    )
    return Table("F all", "F. All scores", caption, head, rows)


def _row(pools: Pools, name: str, kind: str, measure: str) -> list[Cell]:
    sites = sum(
        len(its.detections[pools.detector][measure].sites) for its in pools.records if name in (HELD_OUT, its.junction)
    )
    best = pools.best(name, [str(setting) for setting in pools.settings()], measure)
    cells = [
        told(pools.rho(name, score, measure)) if score in pools.scores else None
        for score in (RECOMMENDED, str(DEFAULT), str(BETTER))
    ]
    cells.insert(2, told(pools.difference(name, RECOMMENDED, str(DEFAULT), measure)))
    beside: list[Cell] = [None, None, None]
    if best is not None:
        gap = pools.difference(name, RECOMMENDED, best, measure)
        beside = [best.removeprefix("egvs "), told(pools.rho(name, best, measure)), told(gap)]
    return ["together" if name == HELD_OUT else name, kind, sites, *cells, *beside]
