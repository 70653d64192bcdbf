"""Where a pole can stand, by the rules of ``egvs check``; and the free positions along the kerbs of ``egvs new``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import shapely

from egvs.core.errors import InputError
from egvs.creation import junctions
from egvs.creation.junctions import JunctionRegion
from egvs.sensors import site_feasibility
from egvs.sensors.sites import Pose, Site
from egvs.stages import scene_checks
from egvs.stages.inputs import CheckInputs, Inputs
from egvs.traffic import sumo_folder

FOOT_M = 1.0
"""Height of the part of a pole that may be in no solid and in no lane, whatever the height of its sensor."""


class PoleCheck:
    """The rules for poles of one scenario.

    Parameters
    ----------
    inputs
        The scenario, and what it names.
    """

    def __init__(self, inputs: Inputs) -> None:
        scenario = inputs.scenario
        # candidates of a file are reported, not dropped
        sites_config = scenario.sites.model_copy(update={"only_free": False})
        scenario = scenario.model_copy(update={"sites": sites_config})
        self._checked = CheckInputs(
            scenario, inputs.network, inputs.carriageway, inputs.built_world[0], (), inputs.plain_scene
        )

    def problem(self, name: str, x_m: float, y_m: float, heights_m: list[float], sensor: str) -> str:
        """Return why no pole can stand at a position of the world frame; empty if one can.

        Parameters
        ----------
        name
            Name of the pole.
        x_m, y_m
            The position.
        heights_m
            Heights of its sensors above the ground.
        sensor
            Name of the sensor.
        """
        scene = self._checked.scene
        assert scene is not None
        try:
            model = scene.sensor(sensor)
            ground_m = 0.0
            if scene.scenario.statics.ground:
                ground_m = site_feasibility.ground_height_m(scene.world, Pose(x_m, y_m, 0.0))
            sites = [Site(name, Pose(x_m, y_m, ground_m + above_m), sensor) for above_m in (FOOT_M, *heights_m)]
            for site in sites:
                site_feasibility.check_pose(scene, site.pose, model, f"site {name}")
        except InputError as error:
            return f"{error.problem}. {error.hint}".strip(" .") + "."
        for finding in scene_checks.warn_sites_on_lanes(replace(self._checked, sites=tuple(sites[:1]))):
            _, _, where = finding.problem.partition(") is ")
            return f"A pole cannot stand {where or finding.problem}."
        return ""


def kerb_positions(inputs: Inputs) -> list[dict[str, Any]]:
    """Return the free positions along the kerbs of the junction in the middle of the region of interest."""
    scenario, world = inputs.scenario, inputs.built_world[0]
    path = sumo_folder.network_path(scenario)
    if path is None:
        return []
    streets = junctions.read_streets(path)
    (x_m, y_m, _), (width_m, depth_m, _) = scenario.roi.center_m, scenario.roi.size_m
    nearby = junctions.choose_nearby(junctions.nearest_junctions(streets, (x_m, y_m)))
    if nearby is None:
        return []
    solids: list[Any] = []
    for number in range(len(world.solids)):
        if world.solids[number][1] != "ground":
            corners_m = world.triangles_m[world.solid_of_face == number][:, :, :2]
            solids.append(shapely.MultiPoint(corners_m.reshape(-1, 2)).convex_hull)
    region = JunctionRegion((x_m, y_m), (width_m, depth_m))
    poles = junctions.kerbside_poles(streets, nearby.junction, region, solids)
    return [{"x_m": pole.x_m, "y_m": pole.y_m, "kind": "kerb"} for pole in poles]
