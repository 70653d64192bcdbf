"""Vehicles with many points."""

from egvs.scoring.target_scores import VehicleScore

HALF_SEEN = VehicleScore(
    name="half_seen",
    formula="n / (n + 5), with n points on the vehicle",
    source="an example",
    function=lambda visible: visible.points / (visible.points + 5.0),
)
