"""Positions of another point of the vehicles than that of the format: bumpers for centres, centres for bumpers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from tests.planted.case import Case, fcd, key, make, track
from tests.planted.scenes import tracks
from tests.planted.truth import FRAMES, PERIOD_S, SIZES_M, STREET, Box, Truth, drive, traffic


def queue() -> list[list[Box]]:
    """Twelve cars and trucks that stand one behind the other on the lane to the east, with gaps of 1.8 to 2.4 m."""
    boxes, front_m = [], 80.0
    for number in range(12):
        kind = "truck" if number % 3 == 1 or number % 5 == 0 else "car"
        length_m, width_m, height_m = SIZES_M[kind]
        x_m = front_m - 0.5 * length_m
        box = Box(f"q{number}", kind, x_m, -1.61, 0.5 * height_m, 0.0, length_m, width_m, height_m, 0.0)
        boxes.append([box] * FRAMES)
        front_m -= length_m + 1.8 + 0.2 * (number * 7 % 4)
    return boxes


def circle() -> list[list[Box]]:
    """Five cars that drive round a circle, each along its own axis."""
    length_m, width_m, height_m = SIZES_M["car"]
    radius_m, speed_m_s = 14.0, 3.0
    tracks_of_cars = []
    for number in range(5):
        boxes = []
        for k in range(FRAMES):
            at_rad = 0.4 * math.pi * number + 0.05 + speed_m_s / radius_m * PERIOD_S * k
            x_m, y_m = -2.0 + radius_m * math.cos(at_rad), -2.0 + radius_m * math.sin(at_rad)
            yaw_rad = at_rad + 0.5 * math.pi
            size = (length_m, width_m, height_m)
            boxes.append(Box(f"c{number}", "car", x_m, y_m, 0.5 * height_m, yaw_rad, *size, speed_m_s))
        tracks_of_cars.append(boxes)
    return tracks_of_cars


QUEUE = replace(STREET, periods=((1.0, traffic(*queue(), drive("b", "truck", 58.77, 1.57, -1.97))),))
CIRCLE = replace(STREET, periods=((1.0, traffic(*circle())),), region_m=(-2.0, -2.0, 2.5), size_m=(24.0, 24.0, 5.0))


def along(row: dict[str, Any], share: float) -> dict[str, float]:
    """Position of a row of tracks, moved along the vehicle by a share of its length."""
    way_m = share * row["l"]
    return {"x": row["x"] + way_m * math.cos(row["a"]), "y": row["y"] + way_m * math.sin(row["a"])}


def x_of_fcd(share: float) -> Callable[[dict[str, Any]], float]:
    """The x of FCD on the street, moved along the vehicle by a share of its length."""
    return lambda row: row["x"] + share * SIZES_M[row["type"]][0] * math.sin(math.radians(row["angle"]))


def round_a_circle() -> Any:
    """Tracks of the circle; no network has such a road."""
    scene = tracks(CIRCLE)
    del scene.config["traffic.roads"]
    return scene


def in_tracks(name: str, scene: Callable[[], Any], share: float, words: str) -> Case:
    """A case of tracks whose positions are moved."""
    plant = track(x=lambda row: along(row, share)["x"], y=lambda row: along(row, share)["y"])
    return Case(name, scene, plant, "traffic.tracks", words, is_error=False, extension="tracks")


def in_fcd(name: str, share: float, words: str, **more: Any) -> Case:
    """A case of FCD whose positions are moved."""
    scene = make(truth=QUEUE, **more)
    return Case(name, scene, fcd(x=x_of_fcd(share)), "traffic.fcd = 'fcd.csv'", words, is_error=False)


def without_network(truth: Truth) -> Callable[[], Any]:
    """A street without its network."""
    return make(key("traffic.roads", None), truth=truth)


REFERENCE_POINTS = (
    in_fcd("centres in FCD", -0.5, "behind the front bumper by half the length of each vehicle"),
    in_fcd("positions ahead of the bumpers in FCD", 0.5, "ahead of the front bumper by half the length"),
    Case(
        "centres in FCD without a network",
        without_network(QUEUE),
        fcd(x=x_of_fcd(-0.5)),
        "traffic.fcd = 'fcd.csv'",
        "these look like centres",
        is_error=False,
    ),
    in_tracks("front bumpers in tracks", partial(tracks, QUEUE), 0.5, "these look like front bumpers"),
    in_tracks("rear bumpers in tracks", partial(tracks, QUEUE), -0.5, "these look like rear bumpers"),
    in_tracks("front bumpers of vehicles that turn", round_a_circle, 0.5, "turn about a point 1.00 lengths behind"),
    in_tracks("rear bumpers of vehicles that turn", round_a_circle, -0.5, "these look like rear bumpers"),
)
