"""Classes of traffic: every vClass that has a body has a class, and cars are those of the ground truth."""

import tomllib

from egvs.validation import cloud_simulation, sweeps
from egvs.validation.sweeps import CAR_VCLASSES


def test_every_kind_has_a_class():
    known = tomllib.loads(cloud_simulation.BODIES_FILE.read_text())["classes"]
    assert {name for name in known if sweeps.object_class(name) == "Misc"} == set()
    assert {name for name in known if sweeps.object_class(name) == "Car"} == CAR_VCLASSES
    assert {sweeps.object_class(name) for name in known} | {"Trailer", "Misc"} == set(sweeps.CLASSES)


def test_rear_parts_are_trailers_but_not_of_buses():
    assert [sweeps.object_class("truck", part) for part in (0, 1)] == ["Truck", "Trailer"]
    assert [sweeps.object_class("bus", part) for part in (0, 1)] == ["Bus", "Bus"]
    assert sweeps.object_class("ship") == "Misc"
