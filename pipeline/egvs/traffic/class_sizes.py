"""Sizes of road users: usual ones of each class, each with its source, and sizes that no vehicle has. Metres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from egvs.core.errors import Diagnostic
from egvs.core.wording import list_first
from egvs.scenario.traffic_config import TrafficConfig
from egvs.traffic.network import ROAD_VCLASSES
from egvs.traffic.vehicle_boxes import VehicleSize

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


SIZE_LIMITS_M = ((2.0, 80.0), (1.0, 4.0), (0.8, 6.0))
"""Smallest and largest length, width and height of motor vehicles: from microcars to double trams and heavy loads."""

SMALL_SIZE_LIMITS_M = ((0.8, 4.0), (0.3, 2.0), (0.5, 3.0))
"""Those of motorcycles and mopeds, with three wheels, too."""

_SMALL_VCLASSES = ("motorcycle", "moped")
_MAX_LISTED_SIZES = 3


def warn_unusual_sizes(
    sizes: Mapping[str, VehicleSize], where: str, tolerated_share: float = 0.0
) -> Iterator[Diagnostic]:
    """Warn about sizes that no motor vehicle has: centimetres, feet, length and width swapped.

    Parameters
    ----------
    sizes
        Size of each vehicle type.
    where
        File and key, for the message.
    tolerated_share
        Share of the types of motor vehicles that may have such a size; a recording has some.
    """
    motor = {name: size for name, size in sizes.items() if size.vclass in ROAD_VCLASSES}
    unusual = []
    for name, size in motor.items():
        limits_m = SMALL_SIZE_LIMITS_M if size.vclass in _SMALL_VCLASSES else SIZE_LIMITS_M
        size_m = (size.length_m, size.width_m, size.height_m)
        if not all(low <= value <= high for value, (low, high) in zip(size_m, limits_m, strict=True)):
            usual = ", ".join(f"{low:g} to {high:g}" for low, high in limits_m)
            unusual.append(f"{name} ({size.vclass}): {' x '.join(f'{v:g}' for v in size_m)} m (usual: {usual} m)")
    if len(unusual) > tolerated_share * len(motor):
        problem = f"expected usual sizes of vehicles, got {list_first(unusual, _MAX_LISTED_SIZES)}"
        hint = "Check the units, and that lengths and widths are not swapped."
        yield Diagnostic("vehicle sizes", where, problem, hint)
