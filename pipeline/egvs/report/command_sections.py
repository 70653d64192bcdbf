"""Sections of the page on what-ifs, installation sheets, acceptance checks and sensor design.

An entry is shown while it belongs to the run (:mod:`egvs.results.command_entries`). A site must still have the pose of
the sheet, or the planned one of the acceptance check.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from egvs.artefacts.run_folder import RunFile, RunFolder
from egvs.core.wording import format_percent
from egvs.results.command_entries import Entries
from egvs.results.labels import SCORE_LABELS, format_probability
from egvs.results.ranking import RankedSite
from egvs.results.sensors import ScoreDifference, difference_unit, format_difference
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.sensors.sites import Pose

_POSE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class WhatIfRow:
    """The answer of one table of solids, in words."""

    name: str
    share: str
    best_before: str
    best_present: str
    best_expected: str
    change: str
    chance: str
    conclusion: str


@dataclass(frozen=True)
class InstallationRow:
    """A site with its installation sheet, in words; ``sheet`` is the path in the run folder, empty if elsewhere."""

    site: str
    sensor: str
    height: str
    bearing: str
    tilt: str
    tolerances: tuple[str, ...]
    file: str
    sheet: str


@dataclass(frozen=True)
class AcceptanceRow:
    """A site with the verdict on its sensor; ``page`` is the path in the run folder, empty if elsewhere."""

    site: str
    sensor: str
    passed: bool
    reasons: tuple[str, ...]
    page: str


@dataclass(frozen=True)
class DesignRow:
    """A sensor at its best mount, in words."""

    sensor: str
    height: str
    yaw: str
    pitch: str
    search: str
    score: str
    gain: str
    is_chosen: bool


@dataclass(frozen=True)
class DesignTable:
    """The sensors for one pole, and the numbers of frames of the search and of the scores."""

    pole: str
    best: str
    search_frames: int
    other_frames: int
    rows: tuple[DesignRow, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class CommandSections:
    """Results of ``egvs what-if``, ``sheets``, ``accept`` and ``sensor design`` for a run; empty without any."""

    what_ifs: tuple[WhatIfRow, ...] = ()
    change_unit: str = ""
    installations: tuple[InstallationRow, ...] = ()
    acceptances: tuple[AcceptanceRow, ...] = ()
    designs: tuple[DesignTable, ...] = ()

    @classmethod
    def of(
        cls, current: Mapping[str, Entries], sites: Iterable[RankedSite], plan: Mapping[str, Pose]
    ) -> CommandSections:
        """Return the results of a run in words.

        Parameters
        ----------
        current
            The entries that belong to the run, by file and name.
        sites
            The ranked sites, at least one.
        plan
            Poses of the sensors of the plan, by site.
        """
        ranked = tuple(sites)
        poses = {
            site.site: Pose(site.x_m, site.y_m, site.z_m, site.yaw_deg, site.pitch_deg, site.roll_deg)
            for site in ranked
        } | dict(plan)

        def entries(file: RunFile) -> Entries:
            return current.get(file.name, {})

        def installed(file: RunFile) -> Entries:
            return {name: value for name, value in entries(file).items() if _is_at(value["pose"], poses.get(name))}

        what_ifs = entries(RunFolder.what_if)
        return cls(
            tuple(_what_if_row(name, values, ranked[0]) for name, values in what_ifs.items()),
            difference_unit(ranked[0]),
            tuple(_installation_row(name, values) for name, values in installed(RunFolder.sheets).items()),
            tuple(_acceptance_row(name, values) for name, values in installed(RunFolder.acceptance).items()),
            tuple(_design_table(name, values) for name, values in entries(RunFolder.sensor_design).items()),
        )


def _is_at(recorded: Mapping[str, float], pose: Pose | None) -> bool:
    """Whether a recorded pose is the present one of the site."""
    if pose is None:
        return False
    return all(
        math.isclose(recorded[name], value, rel_tol=0.0, abs_tol=_POSE_TOLERANCE)
        for name, value in asdict(pose).items()
    )


def _difference(value: Mapping[str, Any]) -> ScoreDifference:
    return ScoreDifference(value["value"], value["se"], value["better"], is_paired=True)


def _what_if_row(name: str, values: Mapping[str, Any], site: RankedSite) -> WhatIfRow:
    change, chance = "not possible with it", "certain"
    if values["change"] is not None:
        change = format_difference(_difference(values["change"]), site)
        chance = "–"
        if values["overtakes"] is not None:
            chance = f"{format_probability(values['overtakes'])} ({values['rival']})"
    share = "–" if values["share"] is None else format_percent(values["share"], 0)
    return WhatIfRow(
        name, share, values["best_before"], values["best_present"] or "–", values["best_expected"], change, chance,
        values["conclusion"],
    )  # fmt: skip


def _installation_row(name: str, values: Mapping[str, Any]) -> InstallationRow:
    pose = values["pose"]
    tilt = "level"
    if pose["pitch_deg"]:
        tilt = f"{abs(pose['pitch_deg']):.1f}° {'up' if pose['pitch_deg'] > 0 else 'down'}"
    if pose["roll_deg"]:
        tilt += f", roll {abs(pose['roll_deg']):.1f}° {'left' if pose['roll_deg'] > 0 else 'right'} side up"
    return InstallationRow(
        name, values["sensor"], f"{values['height_m']:.2f}", f"{round(values['bearing_deg'], 1) % 360.0:.1f}°", tilt,
        tuple(f"{quantity} {limit}" for quantity, limit in values["tolerances"].items()), values["file"],
        values["path"],
    )  # fmt: skip


def _acceptance_row(name: str, values: Mapping[str, Any]) -> AcceptanceRow:
    return AcceptanceRow(name, values["sensor"], values["passed"], tuple(values["reasons"]), values["path"])


def _design_table(pole: str, values: Mapping[str, Any]) -> DesignTable:
    label = SCORE_LABELS[DEFAULT_SCORE]
    rows = []
    for design in values["designs"]:
        difference = _difference(design["difference"])
        gain = f"{100 * difference.value:+z.1f}"
        if difference.se is not None:
            gain += f" ± {100 * difference.se:.1f}"
        if difference.value and not difference.is_clear:
            gain = f"~ {gain}"
        se = math.nan if design["se"] is None else design["se"]
        rows.append(
            DesignRow(
                design["sensor"], f"{design['height_m']:.2f}", f"{design['yaw_deg']:.1f}",
                f"{design['pitch_deg']:z.1f}", label.value(design["search_score"]),
                label.with_error(design["score"], se), gain, design["chosen"],
            )
        )  # fmt: skip
    search, others = values["frames"]
    return DesignTable(pole, values["designs"][0]["sensor"], search, others, tuple(rows), tuple(values["notes"]))
