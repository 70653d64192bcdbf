"""What detectors call the kinds of traffic: the class of a box by its SUMO vClass.

======================================================================== ==============
SUMO vClass                                                              class
======================================================================== ==============
passenger, taxi, evehicle, hov, private, vip, authority                  ``Car``
delivery, emergency                                                      ``Van``
truck, trailer, army                                                     ``Truck``
the rear parts of an articulated vehicle, but of a bus or a tram         ``Trailer``
bus, coach                                                               ``Bus``
tram, rail, rail_urban, rail_electric, rail_fast, subway, cable_car      ``Tram``
motorcycle, moped                                                        ``Motorcycle``
bicycle, scooter                                                         ``Cyclist``
pedestrian, wheelchair                                                   ``Pedestrian``
any other                                                                ``Misc``
======================================================================== ==============

Where KITTI has a name for it, it is KITTI's.
"""

from __future__ import annotations

from pipeline.artefacts.traffic_frames import TrafficFrame

CLASSES = ("Car", "Van", "Truck", "Trailer", "Bus", "Tram", "Motorcycle", "Cyclist", "Pedestrian", "Misc")
"""All of them, in the order of listings."""

CARS = frozenset({"passenger", "taxi", "evehicle", "hov", "private", "vip", "authority"})
"""SUMO vClasses that are cars."""

_OF = dict.fromkeys(CARS, "Car") | {
    "delivery": "Van",
    "emergency": "Van",
    "truck": "Truck",
    "trailer": "Truck",
    "army": "Truck",
    "bus": "Bus",
    "coach": "Bus",
    **dict.fromkeys(("tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car"), "Tram"),
    "motorcycle": "Motorcycle",
    "moped": "Motorcycle",
    "bicycle": "Cyclist",
    "scooter": "Cyclist",
    "pedestrian": "Pedestrian",
    "wheelchair": "Pedestrian",
}


def class_of(vclass: str, part: int = 0) -> str:
    """The class of a box; ``part`` is above 0 for the rear parts of an articulated vehicle."""
    found = _OF.get(vclass, "Misc")
    return "Trailer" if part and found not in ("Bus", "Tram") else found


def of_frame(frame: TrafficFrame) -> tuple[str, ...]:
    """The class of each box of a frame."""
    return tuple(class_of(kind, part) for kind, part in zip(frame.kinds, frame.part.tolist(), strict=True))
