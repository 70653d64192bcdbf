"""Results of the validation study (docs/validity.md) that the report states beside its own.

They are in a file beside this module, each part with its source: the command that computed it, and where.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict


class _Results(BaseModel):
    """Results of one part of the study.

    Attributes
    ----------
    source
        The command that computed them, and the tables that it wrote.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str


class FirstStudy(_Results):
    """Results at the held-out junctions of the first study.

    Attributes
    ----------
    rho
        Rank correlation (Spearman's rho) with AP (mean of BEV and 3D, IoU 0.7): score -> detector -> mean rho. The EGVS
        has one entry per setting, named by :func:`egvs.report.ranking_text.egvs_setting`.
    """

    rho: dict[str, dict[str, float]]


class LargerStudy(_Results):
    """Results of the recommended score at the held-out junctions of the larger study, and what the sensors were.

    They are of the models before their correction for streets, without losses of returns.

    Attributes
    ----------
    rho, rho_at_equal_height
        Lowest and highest rank correlation with AP, over junctions and detectors; among all sites, and those of equal
        height (mean of three heights).
    loss_points, largest_loss_points
        AP lost by the site that the score ranks first, in percentage points: what all junctions and detectors but one
        stay below, and the loss of that one.
    level_error_points
        Smallest and largest root mean square error of the share of vehicles found, over the junctions, by the detectors
        that the score stands for; in percentage points, of the better half of the sites.
    largest_level_error_points
        Largest such error by another detector.
    underrated_sensors, underrated_points
        Sensors with which more is found than expected, and by how many percentage points, at least and at most.
    pitch_deg, roll_deg
        Limits of pitch, and of roll to either side, of the sensors.
    """

    rho: tuple[float, float]
    rho_at_equal_height: tuple[float, float]
    loss_points: int
    largest_loss_points: int
    level_error_points: tuple[int, int]
    largest_level_error_points: int
    underrated_sensors: tuple[str, str]
    underrated_points: tuple[int, int]
    pitch_deg: tuple[float, float]
    roll_deg: float


class StreetLevels(_Results):
    """Level errors of the score on simulated streets that no model was fitted at.

    Attributes
    ----------
    error_points
        By the model of a detector, then by group of road users and for all: root mean square error of the share found,
        of the better half of the sites, over all streets; in percentage points, rounded up.
    street_error_points
        By the model of a detector: the smallest and the largest such error of a single street, for all road users.
    other_detector_error_points
        The same for a detector without a model, compared with the mean of the models.
    rho_in_larger_study, junctions_of_larger_study
        Lowest and highest rank correlation of the corrected models with AP at held-out junctions of the larger study,
        over detectors, and how many of these junctions were computed again.
    groups
        By the model of a detector, the groups of road users at which the level was measured and is near enough.
    """

    error_points: dict[str, dict[str, float]]
    street_error_points: dict[str, tuple[int, int]]
    other_detector_error_points: tuple[int, int]
    rho_in_larger_study: tuple[float, float]
    junctions_of_larger_study: int
    groups: dict[str, tuple[str, ...]]


class HeightsFromSensor(_Results):
    """The test of the score for a detector that measures heights from the sensor, at one junction.

    Attributes
    ----------
    sites
        Number of sites.
    """

    sites: int


class StudyResults(BaseModel):
    """All results, by part of the study."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    first_study: FirstStudy
    larger_study: LargerStudy
    street_levels: StreetLevels
    heights_from_sensor: HeightsFromSensor


STUDY = StudyResults.model_validate_json(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
