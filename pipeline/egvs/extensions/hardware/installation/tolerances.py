"""How far a sensor may be off until its score drops by a point: rescore the site at other heights and angles.

Each quantity is changed alone, by fixed steps to both sides, and the site is scored from there with the recorded
traffic. The tolerance is where the loss first reaches one point (0.01 of a share; 1 % of a score with another unit),
linear between the steps. All poses are scored with the same recorded vehicles, so differences have less noise than
scores.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from egvs.explore.session import Session
from egvs.results.labels import SCORE_LABELS
from egvs.sensors.sites import Site

POINT = 0.01
"""Loss that counts as one point, as a share."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of a pose, and the steps by which it is changed to both sides.

    Attributes
    ----------
    name
        For readers.
    parameter
        The field of :class:`egvs.sensors.sites.Pose`.
    unit
        For readers.
    steps
        Ascending, above 0.
    directions
        What a lower and a higher value of the parameter mean.
    """

    name: str
    parameter: str
    unit: str
    steps: tuple[float, ...]
    directions: tuple[str, str]


QUANTITIES = (
    Quantity("tilt", "pitch_deg", "degrees", (1.0, 2.0, 4.0), ("down", "up")),
    Quantity("roll", "roll_deg", "degrees", (1.0, 2.0, 4.0), ("right side up", "left side up")),
    Quantity("bearing", "yaw_deg", "degrees", (2.0, 5.0, 10.0), ("clockwise", "counter-clockwise")),
    Quantity("height", "z_m", "m", (0.25, 0.5, 1.0), ("lower", "higher")),
)


@dataclass(frozen=True)
class Tolerance:
    """How far one quantity may be off.

    Attributes
    ----------
    quantity
        The quantity.
    offsets
        The changes that were scored, ascending, with 0; poses where no sensor can be mounted are left out.
    losses
        What each loses, in points; negative for a gain.
    down, up
        Distance to lower and higher values at which the loss reaches a point; infinite if it does not.
    """

    quantity: Quantity
    offsets: tuple[float, ...]
    losses: tuple[float, ...]
    down: float
    up: float

    @property
    def limit(self) -> float:
        """The smaller of both distances."""
        return min(self.down, self.up)

    @property
    def tried(self) -> float:
        """The largest change that was scored."""
        return max(-self.offsets[0], self.offsets[-1])


@dataclass(frozen=True)
class PoseTolerances:
    """How far the pose of a sensor may be off.

    Attributes
    ----------
    score
        Name of the score.
    planned
        The score at the planned pose.
    frames
        Number of recorded frames that the scores use.
    tolerances
        One for each of :data:`QUANTITIES`; empty where other poses cannot be scored.
    """

    score: str
    planned: float
    frames: int
    tolerances: tuple[Tolerance, ...]

    @property
    def point(self) -> str:
        """One point in words."""
        return "1 percentage point" if SCORE_LABELS[self.score].is_share else "1 %"


def pose_tolerances(session: Session, site: Site) -> PoseTolerances:
    """Return how far the pose of a site may be off until its score drops by a point.

    Parameters
    ----------
    session
        The run.
    site
        The site at its planned pose; one with a measured scan has no tolerances, since it cannot be scanned elsewhere.
    """
    name = session.rank_by
    planned = session.rate(site.name, site.pose).scores[name]
    point = POINT if SCORE_LABELS[name].is_share else POINT * planned
    tolerances = []
    if site.points is None and point > 0.0:
        for quantity in QUANTITIES:
            losses = {0.0: 0.0}
            for offset in (*(-step for step in quantity.steps), *quantity.steps):
                value = getattr(site.pose, quantity.parameter) + offset
                rated = session.rate(site.name, replace(site.pose, **{quantity.parameter: value}))
                if rated.is_feasible:
                    losses[offset] = (planned - rated.scores[name]) / point
            tolerances.append(_tolerance(quantity, losses))
    return PoseTolerances(name, planned, session.frames, tuple(tolerances))


def _tolerance(quantity: Quantity, losses: dict[float, float]) -> Tolerance:
    offsets = sorted(losses)
    down = distance_to_one_point([(-offset, losses[offset]) for offset in reversed(offsets) if offset <= 0.0])
    up = distance_to_one_point([(offset, losses[offset]) for offset in offsets if offset >= 0.0])
    return Tolerance(quantity, tuple(offsets), tuple(losses[offset] for offset in offsets), down, up)


def distance_to_one_point(losses: Sequence[tuple[float, float]]) -> float:
    """Return the distance at which a loss first reaches 1; infinite if it does not.

    Parameters
    ----------
    losses
        Distance and loss, by ascending distance, from (0, 0).

    Examples
    --------
    >>> distance_to_one_point([(0.0, 0.0), (1.0, 0.5), (2.0, 1.5)])
    1.5
    >>> distance_to_one_point([(0.0, 0.0), (1.0, -0.2)])
    inf
    """
    for (near, loss_near), (far, loss_far) in itertools.pairwise(losses):
        if loss_far >= 1.0:
            return near + (far - near) * (1.0 - loss_near) / (loss_far - loss_near)
    return math.inf


def describe_tolerances(tolerances: PoseTolerances) -> str:
    """Return the tolerances as a sentence, e.g. "a loss of 1 percentage point allows: tilt 2.1 degrees"."""
    parts = []
    for tolerance in tolerances.tolerances:
        quantity = tolerance.quantity
        if math.isinf(tolerance.limit):
            parts.append(f"{quantity.name} more than {tolerance.tried:g} {quantity.unit}")
        else:
            parts.append(f"{quantity.name} {format_distance(tolerance.limit, quantity)}")
    if not parts:
        return "unknown, because other poses cannot be scored"
    return f"a loss of {tolerances.point} allows: {', '.join(parts)}"


def format_distance(value: float, quantity: Quantity) -> str:
    """Return a distance with its unit: degrees with one decimal, metres with two."""
    digits = 2 if quantity.unit == "m" else 1
    return f"{value:.{digits}f} {quantity.unit}"
