"""Classes of traffic: every vClass that has a body has a class, and cars are those of the ground truth."""

import tomllib

from pipeline.validation import classes
from pipeline.validation.classes import CARS
from pipeline.validation.clouds import bodies


def test_every_kind_has_a_class():
    known = tomllib.loads(bodies.FILE.read_text())["classes"]
    assert {name for name in known if classes.class_of(name) == "Misc"} == set()
    assert {name for name in known if classes.class_of(name) == "Car"} == CARS
    assert {classes.class_of(name) for name in known} | {"Trailer", "Misc"} == set(classes.CLASSES)


def test_rear_parts_are_trailers_but_not_of_buses():
    assert [classes.class_of("truck", part) for part in (0, 1)] == ["Truck", "Trailer"]
    assert [classes.class_of("bus", part) for part in (0, 1)] == ["Bus", "Bus"]
    assert classes.class_of("ship") == "Misc"
