"""Tables F: how well the recommended score predicts detection at junctions that were not used for training or choices.

The score came after the tables A to E: it was trained on the training junctions (``benchmarks/detectability``), so
nothing is reported for them. It is compared with EGVS at every setting that was tried, also with the one that is best
at the very same sites, which nobody can know in advance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from benchmarks.validity import low_models
from benchmarks.validity.agreement import HELD_OUT, TRAINING, WORDS, coefficient_cell
from benchmarks.validity.failures import COLUMNS, worst
from benchmarks.validity.pools import DEFAULT, Pools, Setting
from benchmarks.validity.record import Record, StudySite, measures_of
from benchmarks.validity.tables import Cell, Column, Table
from egvs.clouds.sweeps import POINT_COUNTS_NAME
from egvs.extensions.validation.results import ScoreName
from egvs.scoring.target_scores import DETECTORS

RECOMMENDED = str(ScoreName("expected_detections", f'{{"detectors": "{"+".join(DETECTORS)}"}}'))
"""The recommended score: the mean probability over the detectors that have a model."""

LATER = ("seen_well", "expected_detections")
"""Scores that were added after A to E; these tables do not contain them."""

BETTER = Setting(2.0, DEFAULT.voxel_m, False)
"""The value of ``gamma = "auto"`` with default voxels, chosen on training junctions."""

_KINDS: dict[str, Callable[[StudySite], bool]] = {
    "all": lambda site: True,
    "given": lambda site: site.is_given,
    "grid": lambda site: not site.is_given,
}


def without_later_scores(records: Sequence[Record]) -> list[Record]:
    """Return what A to E are based on: junctions and scores that existed then."""
    known = [record for record in records if record.role in (TRAINING, HELD_OUT)]
    return [
        replace(record, scores={name: v for name, v in record.scores.items() if not name.startswith(LATER)})
        for record in known
    ]


def tables(records: Sequence[Record], detectors: Sequence[str]) -> Iterator[Table]:
    """Yield tables F: coefficients for each detector, and the sites that the score ranks worst."""
    others = [record for record in records if record.role != TRAINING and RECOMMENDED in record.scores]
    named = [name for name in detectors if name not in low_models.NAMES]
    pairs = [(name, [record for record in others if name in record.detections]) for name in named]
    for name, with_detector in ((name, record) for name, record in pairs if record):
        yield from (_coefficients(with_detector, name, measure) for measure in measures_of(name))
    if boxed := [(name, record) for name, record in pairs if record and name != POINT_COUNTS_NAME]:
        yield _every_score(boxed)
    for name, with_detector in ((name, record) for name, record in pairs if record):
        measure = measures_of(name)[0]
        rows = [row for record in with_detector for row in worst(record, name, measure, RECOMMENDED)]
        caption = (
            f"The sites whose rank by {RECOMMENDED} differs most from their rank by {WORDS[measure]} ({name}); columns"
            " as in E."
        )
        yield Table(f"F worst {name}", "F. Where the recommended score fails", caption, COLUMNS, rows)


def _coefficients(records: Sequence[Record], detector: str, measure: str) -> Table:
    rows: list[list[Cell]] = []
    for kind, is_selected in _KINDS.items():
        some = [replace(record.only(is_selected), role=HELD_OUT) for record in records]
        pools = Pools([record for record in some if record.detections[detector][measure].sites], detector)
        names = [name for name in pools.studies if name != HELD_OUT or len(pools.records) > 1]
        rows += [_row(pools, name, kind, measure) for name in names]
    head = [Column("junction"), Column("sites"), Column("number of sites", "whole")]
    head += [
        Column(record, "two")
        for record in ("recommended", "EGVS, gamma 10", "recommended minus gamma 10", "EGVS, gamma 2")
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
    """Return all scores over all these junctions together; the program refers to it when scores disagree."""
    together = [Pools([replace(record, role=HELD_OUT) for record in records], name) for name, records in boxed]
    measures = [measures_of(pools.detector)[0] for pools in together]
    rho = [
        {score: pools.rho(HELD_OUT, score, measure) for score in pools.scores}
        for pools, measure in zip(together, measures, strict=True)
    ]
    names = [name for name in rho[0] if all(name in record for record in rho)]
    total = {name: sum(record[name].value for record in rho) for name in names}
    order = sorted(names, key=lambda name: math.inf if math.isnan(total[name]) else -total[name])
    rows: list[list[Cell]] = [[name, *(coefficient_cell(record[name]) for record in rho)] for name in order]
    head = [Column("score"), *(Column(pools.detector, "two") for pools in together)]
    caption = (
        f"Rho of every score with {WORDS[measures[0]]}, over all junctions that were not used for training, given and"
        " grid sites together."
    )
    return Table("F all", "F. All scores", caption, head, rows)


def _row(pools: Pools, name: str, kind: str, measure: str) -> list[Cell]:
    sites = sum(
        len(record.detections[pools.detector][measure].sites)
        for record in pools.records
        if name in (HELD_OUT, record.junction)
    )
    best = pools.best(name, [str(setting) for setting in pools.settings()], measure)
    cells = [
        coefficient_cell(pools.rho(name, score, measure)) if score in pools.scores else None
        for score in (RECOMMENDED, str(DEFAULT), str(BETTER))
    ]
    cells.insert(2, coefficient_cell(pools.difference(name, RECOMMENDED, str(DEFAULT), measure)))
    best_cells: list[Cell] = [None, None, None]
    if best is not None:
        gap = pools.difference(name, RECOMMENDED, best, measure)
        best_cells = [
            best.removeprefix("egvs "),
            coefficient_cell(pools.rho(name, best, measure)),
            coefficient_cell(gap),
        ]
    return ["together" if name == HELD_OUT else name, kind, sites, *cells, *best_cells]
