"""Sizes of road users that a recording does not state, by class, each with its source. Metres."""

from __future__ import annotations

from dataclasses import dataclass

from egvs.scenario.traffic_config import TrafficConfig

_FLEET = "default fleet"
_SIND = "mean in SinD, Tianjin"
_KITTI = "anchor box of Lang et al. 2019, arXiv 1812.05784"


@dataclass(frozen=True)
class ClassSize:
    """Usual size of a class of road users.

    Attributes
    ----------
    length_m, width_m, height_m
        Size of the box.
    vclass
        SUMO's class of vehicles.
    source
        Where length and width come from.
    """

    length_m: float
    width_m: float
    height_m: float
    vclass: str
    source: str


CLASS_SIZES = {
    "car": ClassSize(4.55, 1.80, 1.50, "passenger", f"{_SIND}, 268 cars; height of the {_FLEET}"),
    "van": ClassSize(4.90, 1.90, 2.10, "delivery", _FLEET),
    "truck": ClassSize(7.60, 2.30, 3.00, "truck", _FLEET),
    "bus": ClassSize(10.90, 2.50, 3.10, "bus", _FLEET),
    "trailer": ClassSize(13.60, 2.55, 4.00, "trailer", "largest semitrailer of Directive 96/53/EC"),
    "tram": ClassSize(30.00, 2.40, 3.50, "tram", "typical low-floor tram"),
    "motorcycle": ClassSize(1.74, 0.78, 1.60, "motorcycle", f"{_SIND}, 171 motorcycles; height assumed"),
    "bicycle": ClassSize(1.76, 0.60, 1.73, "bicycle", _KITTI),
    "pedestrian": ClassSize(0.80, 0.60, 1.73, "pedestrian", _KITTI),
    "other": ClassSize(2.40, 1.10, 1.60, "moped", f"{_SIND}, 33 tricycles; height assumed"),
}
"""Size of each class of road users in recorded tracks."""


def class_sizes(traffic: TrafficConfig) -> dict[str, ClassSize]:
    """Return the size of each class; a kind of the scenario with the name of a class replaces its size."""
    sizes = dict(CLASS_SIZES)
    for kind in traffic.named_kinds:
        if kind.name in sizes:
            sizes[kind.name] = ClassSize(
                kind.length_m, kind.width_m, kind.height_m, sizes[kind.name].vclass, "traffic.kinds"
            )
    return sizes
