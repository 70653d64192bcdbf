"""The section of the report on installed and designed sensors: sensor design, installation sheets, acceptance checks.

An entry is shown while it belongs to the run (:mod:`egvs.results.command_entries`). A site must still have the pose of
the sheet, or the planned one of the acceptance check.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord
from egvs.extensions.hardware.files import ACCEPTANCE, FILES, PLANNED_KEY, SENSOR_DESIGN, SHEETS, design_digest
from egvs.report.extension_sections import SectionWarning
from egvs.results.labels import SCORE_LABELS
from egvs.results.ranking import RankedSite, describe_roll
from egvs.results.sensors import ScoreDifference
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.sensors.sites import Pose

if TYPE_CHECKING:
    from egvs.results.command_entries import Entries

_POSE_TOLERANCE = 1e-6


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
class HardwareResults:
    """Results of ``egvs sensor design``, ``sheets`` and ``accept`` for a run."""

    designs: tuple[DesignTable, ...]
    installations: tuple[InstallationRow, ...]
    acceptances: tuple[AcceptanceRow, ...]

    @classmethod
    def read(cls, folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> HardwareResults | None:
        """Read the results in a run folder; None if there are none of this run."""
        if not any((folder / file.name).is_file() for file in FILES):
            return None

        from egvs.results.command_entries import current_entries

        designs = current_entries(folder / SENSOR_DESIGN.name, stages, lambda _: design_digest(scenario))
        sheets = current_sheets(folder, stages) if (folder / SHEETS.name).is_file() else {}
        checks = current_entries(folder / ACCEPTANCE.name, stages)
        if checks:
            checks = _at_present_poses(checks, _present_poses(folder, stages)[0])
        if not (designs or sheets or checks):
            return None
        return cls(
            tuple(_design_table(name, values) for name, values in designs.items()),
            tuple(_installation_row(name, values) for name, values in sheets.items()),
            tuple(
                AcceptanceRow(name, values["sensor"], values["passed"], tuple(values["reasons"]), values["path"])
                for name, values in checks.items()
            ),
        )


def current_sheets(folder: RunFolder, stages: Mapping[str, StageRecord]) -> Entries:
    """Return the entries of the sheets that belong to the run and to its plan."""
    from egvs.results.command_entries import current_entries

    poses, planned = _present_poses(folder, stages)
    entries = _at_present_poses(current_entries(folder / SHEETS.name, stages), poses)
    return {name: values for name, values in entries.items() if name in planned or not values.get(PLANNED_KEY)}


def _present_poses(folder: RunFolder, stages: Mapping[str, StageRecord]) -> tuple[dict[str, Pose], set[str]]:
    """Return the poses of the sites of a run, and which of them its plan has: these have the planned pose."""
    from egvs.results.plans import SensorPlan

    poses = {site.site: site.pose for site in RankedSite.read(folder.scores)}
    plan = SensorPlan.read(folder)
    planned = {}
    if plan is not None and plan.belongs_to(stages):
        planned = {sensor.site: sensor.mount.pose for sensor in plan.sensors}
    return poses | planned, set(planned)


def _at_present_poses(entries: Entries, poses: Mapping[str, Pose]) -> Entries:
    """Return the entries of the sites that have their recorded pose."""
    return {name: values for name, values in entries.items() if _is_at(values["pose"], poses.get(name))}


def _is_at(recorded: Mapping[str, float], pose: Pose | None) -> bool:
    """Whether a recorded pose is the present one of the site."""
    if pose is None:
        return False
    return all(
        math.isclose(recorded[name], value, rel_tol=0.0, abs_tol=_POSE_TOLERANCE)
        for name, value in asdict(pose).items()
    )


def _installation_row(name: str, values: Mapping[str, Any]) -> InstallationRow:
    from egvs.extensions.hardware.installation.sheet import describe_side_tilt

    pose = values["pose"]
    tilt = "level"
    if pose["pitch_deg"]:
        tilt = f"{abs(pose['pitch_deg']):.1f}° {'up' if pose['pitch_deg'] > 0 else 'down'}"
    if Pose(**pose).is_inverted:
        tilt += ", upside down"
    if side := describe_side_tilt(Pose(**pose)):
        tilt += f", roll {side}"
    return InstallationRow(
        name, values["sensor"], f"{values['height_m']:.2f}", f"{round(values['bearing_deg'], 1) % 360.0:.1f}°", tilt,
        tuple(f"{quantity} {limit}" for quantity, limit in values["tolerances"].items()), values["file"],
        values["path"],
    )  # fmt: skip


def _design_table(pole: str, values: Mapping[str, Any]) -> DesignTable:
    label = SCORE_LABELS[DEFAULT_SCORE]
    rows = []
    for design in values["designs"]:
        difference = ScoreDifference.from_entry(design["difference"])
        gain = f"{100 * difference.value:+z.1f}"
        if difference.se is not None:
            gain += f" ± {100 * difference.se:.1f}"
        if difference.value and not difference.is_clear:
            gain = f"~ {gain}"
        roll = describe_roll(design.get("roll_deg", 0.0))
        se = math.nan if design["se"] is None else design["se"]
        rows.append(
            DesignRow(
                f"{design['sensor']}, {roll}" if roll else design["sensor"],
                f"{design['height_m']:.2f}", f"{design['yaw_deg']:.1f}",
                f"{design['pitch_deg']:z.1f}", label.value(design["search_score"]),
                label.with_error(design["score"], se), gain, design["chosen"],
            )
        )  # fmt: skip
    search, others = values["frames"]
    return DesignTable(pole, values["designs"][0]["sensor"], search, others, tuple(rows), tuple(values["notes"]))


class HardwareSection:
    """The section, as :class:`egvs.report.extension_sections.ReportSection` describes it."""

    name = "hardware"
    files = tuple(file.name for file in FILES)
    template = Path(__file__).parent / "templates" / "hardware.html.j2"

    def read(self, folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> HardwareResults | None:
        """Return the results that belong to a run; None if there are none."""
        return HardwareResults.read(folder, scenario, stages)

    def warnings(self, values: HardwareResults) -> Iterator[SectionWarning]:
        """Yield none: no result here contradicts the ranking."""
        yield from ()


SECTION = HardwareSection()
