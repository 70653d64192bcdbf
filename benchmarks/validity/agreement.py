"""Tables A, B and D: does EGVS predict detection, with which gamma, and does another score predict it better?

Gamma and the best score are chosen on training junctions only; results of held-out junctions are only reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from benchmarks.validity.pools import DEFAULT, Pools, Setting
from benchmarks.validity.poses import HEIGHTS_M
from benchmarks.validity.record import Record, StudySite, measures_of
from benchmarks.validity.tables import Cell, Column, Table, with_interval
from egvs.extensions.validation.correlation import Correlation

TRAINING, HELD_OUT = "training", "held out"

WORDS = {
    "seen_20": "share of vehicles with 20 points",
    "log_points": "mean log(1 + points) of vehicles",
    "ap_mean_r40_iou70": "AP R40, mean of BEV and 3D, IoU 0.7",
    "ap_mean_r40_iou50": "AP R40, mean of BEV and 3D, IoU 0.5",
    "ap_bev_r40_iou70": "AP R40, BEV, IoU 0.7",
    "ap_3d_r40_iou70": "AP R40, 3D, IoU 0.7",
}


def coefficient_cell(correlation: Correlation | None) -> Cell:
    """Return a coefficient as a cell."""
    return None if correlation is None else with_interval(correlation.value, correlation.interval)


def gamma_word(gamma: float) -> str:
    """Return a gamma as text."""
    return f"{gamma:g}"


def by_setting(pools: Pools) -> Iterator[Table]:
    """A: yield EGVS against detection by gamma, voxel size and moving occlusion, one table per measure."""
    names = list(pools.studies)
    for measure in measures_of(pools.detector):
        rows: list[list[Cell]] = []
        for setting in pools.settings():
            cells = [coefficient_cell(pools.rho(name, str(setting), measure)) for name in names]
            rows.append([gamma_word(setting.gamma), f"{setting.voxel_m:g}", _yes(setting.occlusion), *cells])
        head = [Column("gamma"), Column("voxel, m"), Column("moving occlusion"), *(Column(n, "two") for n in names)]
        caption = f"Spearman's rho between EGVS and {WORDS[measure]} ({pools.detector})."
        section = "A. EGVS by gamma, voxel size and moving occlusion"
        yield Table(f"A {pools.detector} {measure}", section, caption, head, rows)


def by_kind_of_site(pools: Pools) -> Iterator[Table]:
    """A: yield the default EGVS and the best setting on training junctions, for some of the sites only."""
    kinds: dict[str, Callable[[StudySite], bool]] = {
        "all": lambda site: True,
        "given": lambda site: site.is_given,
        "grid": lambda site: not site.is_given,
    }
    for height_m in HEIGHTS_M:
        kinds[f"grid, {height_m:g} m"] = lambda site, h=height_m: not site.is_given and site.height_m == h  # type: ignore[misc]
    some = {
        kind: Pools([pools_.only(is_selected) for pools_ in pools.records], pools.detector)
        for kind, is_selected in kinds.items()
    }
    names = list(pools.studies)
    for measure in measures_of(pools.detector):
        settings = {str(setting) for setting in pools.settings()}
        best = pools.best(TRAINING, [name for name in pools.scores if name in settings], measure)
        rows: list[list[Cell]] = [
            [score, kind, *(coefficient_cell(pools_.rho(name, score, measure)) for name in names)]
            for score in dict.fromkeys(name for name in (str(DEFAULT), best) if name is not None)
            for kind, pools_ in some.items()
        ]
        head = [Column("score"), Column("sites"), *(Column(name, "two") for name in names)]
        caption = (
            f"Rho with {WORDS[measure]} ({pools.detector}): all sites, the given sites only, the grid sites only, and"
            " the grid sites of one height. EGVS at the default setting, and at the setting that is best on the"
            " training junctions."
        )
        section = "A. Given sites and grid sites separately"
        yield Table(f"A sites {pools.detector} {measure}", section, caption, head, rows)


_B_COLUMNS = [
    Column("detector"),
    Column("measure"),
    Column("voxel, m"),
    Column("moving occlusion"),
    Column("best gamma, training"),
    Column("gammas not distinguishable from it"),
    Column("rho, training", "two"),
    Column("minus gamma 10, training", "two"),
    Column("rho, held out", "two"),
    Column("gamma 10, held out", "two"),
    Column("difference, held out", "two"),
]


def chosen_gamma(each: Sequence[Pools]) -> Table:
    """B: return gamma chosen on training junctions for each voxel size, and its result on held-out ones."""
    rows = [
        _chosen_row(pools, measure, [s for s in pools.settings() if (s.voxel_m, s.occlusion) == ground])
        for pools in each
        if TRAINING in pools.studies
        for measure in measures_of(pools.detector)
        for ground in dict.fromkeys((s.voxel_m, s.occlusion) for s in pools.settings())
    ]
    caption = (
        "The gamma with the highest rho on the training junctions; the gammas whose difference from it there has a 95 %"
        " interval that contains 0 (which does not show that they are as good); and what the choice brings on the"
        " held-out junctions, compared with gamma 10 at the same voxel size."
    )
    return Table("B gamma", "B. Gamma chosen on the training junctions", caption, _B_COLUMNS, rows)


def _chosen_row(pools: Pools, measure: str, settings: Sequence[Setting]) -> list[Cell]:
    by_name = {str(setting): setting for setting in settings}
    ground = settings[0]
    head: list[Cell] = [pools.detector, WORDS[measure], f"{ground.voxel_m:g}", _yes(ground.occlusion)]
    name = pools.best(TRAINING, list(by_name), measure)
    if name is None:
        return [*head, *[None] * 7]
    ten = str(Setting(DEFAULT.gamma, ground.voxel_m, ground.occlusion))
    indistinguishable = [
        gamma_word(s.gamma) for s in pools.indistinguishable(TRAINING, by_name[name], settings, measure)
    ]
    cells = [
        coefficient_cell(pools.rho(TRAINING, name, measure)),
        coefficient_cell(pools.difference(TRAINING, name, ten, measure)),
    ]
    if HELD_OUT in pools.studies:
        quoted = [coefficient_cell(pools.rho(HELD_OUT, which, measure)) for which in (name, ten)]
        cells += [*quoted, coefficient_cell(pools.difference(HELD_OUT, name, ten, measure))]
    else:
        cells += [None] * 3
    return [*head, gamma_word(by_name[name].gamma), ", ".join(indistinguishable), *cells]


def by_sensor(records: Sequence[Record], detectors: Sequence[str]) -> list[Table]:
    """B: return the best gamma by sensor and voxel size on training junctions, and whether one gamma suits all."""
    sensors = list(dict.fromkeys(record.sensor for record in records))
    rows: list[list[Cell]] = []
    verdicts: list[list[Cell]] = []
    for detector in detectors:
        every = [(sensor, Pools([r for r in records if r.sensor == sensor], detector)) for sensor in sensors]
        here = [(sensor, pools) for sensor, pools in every if pools.records]
        for measure in measures_of(detector) if here else ():
            cells = [
                (sensor, pools, [s for s in pools.settings() if s.voxel_m == voxel_m and not s.occlusion])
                for sensor, pools in here
                for voxel_m in dict.fromkeys(s.voxel_m for s in pools.settings())
            ]
            rows += [_sensor_row(sensor, pools, settings, measure) for sensor, pools, settings in cells]
            verdicts.append(_verdict(detector, measure, cells))
    head = [Column("detector"), Column("measure"), Column("sensor"), Column("voxel, m"), Column("best gamma"),
            Column("gammas not distinguishable from it"), Column("rho", "two")]  # fmt: skip
    section = "B. Gamma by sensor and voxel size"
    first = (
        "Best gamma on the training junctions by sensor and voxel size, at the same locations, without moving"
        " occlusion."
    )
    second = (
        "The gamma with the highest mean rho over all sensors and voxel sizes, and in how many of these cells a higher"
        " or a lower gamma is better by more than noise. Five differences are tested per cell, so some occur by chance."
    )
    columns = [Column("detector"), Column("measure"), Column("one gamma"), Column("mean rho", "two"),
               Column("cells", "whole"), Column("higher better", "whole"), Column("higher where"),
               Column("lower better", "whole"), Column("lower where")]  # fmt: skip
    return [
        Table("B sensors", section, first, head, rows),
        Table("B one gamma", section, second, columns, verdicts),
    ]


def _sensor_row(sensor: str, pools: Pools, settings: Sequence[Setting], measure: str) -> list[Cell]:
    by_name = {str(setting): setting for setting in settings}
    head: list[Cell] = [pools.detector, WORDS[measure], sensor, f"{settings[0].voxel_m:g}"]
    name = pools.best(TRAINING, list(by_name), measure)
    if name is None:
        return [*head, None, None, None]
    indistinguishable = ", ".join(
        gamma_word(s.gamma) for s in pools.indistinguishable(TRAINING, by_name[name], settings, measure)
    )
    return [
        *head,
        gamma_word(by_name[name].gamma),
        indistinguishable,
        coefficient_cell(pools.rho(TRAINING, name, measure)),
    ]


def _verdict(detector: str, measure: str, cells: Sequence[tuple[str, Pools, Sequence[Setting]]]) -> list[Cell]:
    """Return the one gamma, and the cells where another is better."""

    def mean_rho(gamma: float) -> float:
        all_ = [
            pools.rho(TRAINING, str(s), measure).value for _, pools, pools_ in cells for s in pools_ if s.gamma == gamma
        ]
        return sum(all_) / len(all_)

    means = {gamma: mean_rho(gamma) for gamma in dict.fromkeys(s.gamma for _, _, pools_ in cells for s in pools_)}
    known = {gamma: mean for gamma, mean in means.items() if mean == mean}
    if not known:
        return [detector, WORDS[measure], None, None, len(cells), *[None] * 4]
    one = max(known, key=lambda gamma: known[gamma])
    higher, lower = list[str](), list[str]()
    for sensor, pools, settings in cells:
        pools_ = next(s for s in settings if s.gamma == one)
        for other in settings:
            gap = pools.difference(TRAINING, str(other), str(pools_), measure)
            if gap is not None and gap.interval.low > 0.0:
                (higher if other.gamma > one else lower).append(f"{sensor} at {pools_.voxel_m:g} m")
    cell: list[Cell] = [detector, WORDS[measure], gamma_word(one), round(known[one], 4), len(cells)]
    for where in (higher, lower):
        cell += [len(set(where)), ", ".join(dict.fromkeys(where)) or None]
    return cell


def ranked(pools: Pools) -> Iterator[Table]:
    """D: yield all scores by their rho on training junctions, with their rho on held-out ones."""
    if TRAINING not in pools.studies:
        return
    for measure in measures_of(pools.detector):
        names = candidates(pools, measure)
        rho = {name: pools.rho(TRAINING, name, measure).value for name in names}
        order = sorted(names, key=lambda name: -rho[name] if rho[name] == rho[name] else 2.0)
        best, default = order[0], str(DEFAULT)
        rows: list[list[Cell]] = []
        for name in order:
            quoted = coefficient_cell(pools.rho(HELD_OUT, name, measure)) if HELD_OUT in pools.studies else None
            rows.append([
                name, coefficient_cell(pools.rho(TRAINING, name, measure)), quoted,
                coefficient_cell(pools.difference(HELD_OUT, name, default, measure)),
                coefficient_cell(pools.difference(HELD_OUT, name, best, measure)),
            ])  # fmt: skip
        head = [Column("score")] + [
            Column(heading, "two")
            for heading in (
                "rho, training",
                "rho, held out",
                "minus default EGVS, held out",
                "minus best of training, held out",
            )
        ]
        caption = (
            f"Scores in descending order of their rho with {WORDS[measure]} ({pools.detector}) on the training"
            " junctions. EGVS at the default setting, and at the setting that is best there."
        )
        yield Table(f"D {pools.detector} {measure}", "D. All scores", caption, head, rows)


def candidates(pools: Pools, measure: str) -> list[str]:
    """Return the compared scores; of EGVS only the default and the best setting on training junctions."""
    settings = {str(setting) for setting in pools.settings()}
    best = pools.best(TRAINING, [name for name in pools.scores if name in settings], measure)
    egvs_settings = {str(DEFAULT), best}
    return [name for name in pools.scores if name not in settings or name in egvs_settings]


def _yes(value: bool) -> str:
    return "yes" if value else "no"
