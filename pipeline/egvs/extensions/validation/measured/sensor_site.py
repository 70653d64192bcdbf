"""Where the sensor of measured sweeps stands, and what its beams meet without road users.

Without a scenario the world is the ground plane below the sensor, fitted to all sweeps together: what stands on it
hides nothing. The sensor is above the origin, its x axis along the world's, so that boxes keep their headings up to the
tilt. With a scenario, the pose is that of a site, and the world is that of the scenario.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import number_of
from egvs.formats.sweep_files import Sweep
from egvs.formats.sweep_labels import VCLASSES, SweepLabels
from egvs.scenario.model import Scenario
from egvs.sensors.ground_plane import GroundPlane, find_ground_planes
from egvs.sensors.sensor import Sensor, resolve_sensor, rotation_world_sensor, scenario_sensor
from egvs.sensors.sites import Pose, Site

_UP = np.array([0.0, 0.0, 1.0])

_FEWEST_FOR_TILT = 10
_LEAST_SPREAD_M = 5.0
"""So many boxes, with this standard deviation across the direction of most of them, show the tilt of a sensor."""

_OUTLIER, _BOTTOM_TOLERANCE_M = 4.0, 0.3
_PLANE_STEPS = 4


@dataclass(frozen=True, eq=False)
class SensorSite:
    """The pose of a sensor, and its empty scan.

    Attributes
    ----------
    name
        Name of the site.
    pose, sensor
        Pose in the world, and the sensor.
    directions
        Unit vector of each row of the empty scan along the world's axes, (n, 3) float64.
    range_m
        Where each row ends without road users, (n,) float64: on a surface, or at the range of the sensor.
    beam
        Beam of each row, (n,) int64.
    returned
        Which rows end on a surface, (n,) bool.
    weight
        Share of its beam of each row, (n,) float64.
    assumptions
        Sentences on what is assumed of the world.
    sweep_pose
        Pose of the frame of points and boxes; None for that of the sensor.
    """

    name: str
    pose: Pose
    sensor: Sensor
    directions: FloatArray
    range_m: FloatArray
    beam: IntArray
    returned: np.ndarray[tuple[int], np.dtype[np.bool_]]
    weight: FloatArray
    assumptions: tuple[str, ...]
    sweep_pose: Pose | None = None

    @property
    def frame_pose(self) -> Pose:
        """Pose of the frame of points and boxes."""
        return self.sweep_pose or self.pose

    def to_world(self, boxes: FloatArray) -> FloatArray:
        """Return boxes of the sweeps (n, 7) in the world: upright, headed along the projection of their own."""
        return boxes_in_world(self.frame_pose, boxes)

    def frame(self, number: int, labels: SweepLabels) -> TrafficFrame:
        """Return the labelled boxes of a sweep as a frame of traffic."""
        kinds = tuple(VCLASSES[name] for name in labels.classes)
        return TrafficFrame(number, labels.names, kinds, self.to_world(labels.boxes), np.zeros(len(labels)))


def boxes_in_world(pose: Pose, boxes: FloatArray) -> FloatArray:
    """Return boxes of the frame of a sensor (n, 7) in the world, upright, headed along the projection of their own."""
    return move_boxes(boxes, rotation_world_sensor(*pose.angles_deg), np.asarray(pose.position_m))


def move_boxes(boxes: FloatArray, rotation: FloatArray, translation_m: FloatArray) -> FloatArray:
    """Return boxes (n, 7) in another frame, p_to = rotation p + translation, with their sizes."""
    front = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))]) @ rotation.T
    moved = boxes.copy()
    moved[:, :3] = boxes[:, :3] @ rotation.T + translation_m
    moved[:, 6] = np.arctan2(front[:, 1], front[:, 0])
    return moved


def upright_normals(points_m: FloatArray) -> FloatArray:
    """Return normals that let all points (n, 3) be on the ground."""
    return np.broadcast_to(_UP, points_m.shape)


def on_ground_plane(sensor: Sensor, sweeps: Sequence[Sweep], *, is_inverted: bool = False) -> SensorSite:
    """Return a site above the ground plane that is fitted to sweeps; InputError if they show none.

    Parameters
    ----------
    sensor
        The sensor.
    sweeps
        In its frame.
    is_inverted
        Whether it is upside down, so that z of its frame points downwards.
    """
    returns = [sweep.points_m[np.isfinite(sweep.points_m[:, 0])] for sweep in sweeps]
    points_m = np.concatenate(returns)
    if is_inverted:
        points_m = points_m * (1.0, -1.0, -1.0)
    plane = find_ground_planes(points_m, upright_normals(points_m), sweeps[0].name)[0]
    if is_inverted:
        plane = plane.upside_down()
    pose = Pose(0.0, 0.0, plane.height_m, 0.0, plane.pitch_deg, plane.roll_deg)
    directions = sensor.directions(*pose.angles_deg)
    range_m = np.full(len(directions), float(sensor.range_m))
    down = directions[:, 2] < 0.0
    range_m[down] = np.minimum(range_m[down], -plane.height_m / directions[down, 2])
    weight = np.ones(len(directions)) if sensor.beam_weight is None else sensor.beam_weight
    return SensorSite(
        name="measured",
        pose=pose,
        sensor=sensor,
        directions=directions,
        range_m=range_m,
        beam=np.arange(len(directions)),
        returned=range_m < sensor.range_m,
        weight=weight,
        assumptions=(_describe(plane), "Nothing else of the static world is known, so nothing else hides vehicles."),
    )


def pose_above_boxes(labels: Sequence[SweepLabels]) -> tuple[Pose, str]:
    """Return the pose of a sensor above the plane of the lower faces of its labelled boxes, and a sentence on it."""
    boxes = np.concatenate([item.boxes for item in labels])
    normal, height_m = _plane_of_bottoms(boxes[:, :3] - 0.5 * boxes[:, 5:6] * _UP)
    pitch_deg, roll_deg = np.degrees([np.arcsin(normal[0]), np.arctan2(normal[1], normal[2])]).tolist()
    sentence = (
        f"the lower faces of {number_of(len(boxes), 'box', 'boxes')} are {height_m:.2f} m below the sensor "
        f"(pitch {pitch_deg:.2f}, roll {roll_deg:.2f} degrees); vehicles are hidden by other boxes only"
    )
    return Pose(0.0, 0.0, height_m, 0.0, pitch_deg, roll_deg), sentence


def in_the_open(sensor: Sensor, pose: Pose, sentence: str) -> SensorSite:
    """Return a site in a world without anything: not even the ground stops its beams."""
    directions = sensor.directions(*pose.angles_deg)
    count = len(directions)
    return SensorSite(
        name="labelled",
        pose=pose,
        sensor=sensor,
        directions=directions,
        range_m=np.full(count, float(sensor.range_m)),
        beam=np.arange(count),
        returned=np.zeros(count, dtype=np.bool_),
        weight=np.ones(count) if sensor.beam_weight is None else sensor.beam_weight,
        assumptions=(sentence,),
    )


def _plane_of_bottoms(bottoms_m: FloatArray) -> tuple[FloatArray, float]:
    """Return the normal of the plane of points (n, 3), (3,), and the height of the origin above it.

    A tilt is fitted where boxes are spread in both directions; otherwise the sensor counts as level.
    """
    used = np.ones(len(bottoms_m), dtype=np.bool_)
    slopes = np.zeros(3)
    for _ in range(_PLANE_STEPS):
        x_y = bottoms_m[used, :2]
        spread_m = np.linalg.svd(x_y - x_y.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(x_y)) if len(x_y) else 0.0
        slopes = np.array([0.0, 0.0, np.median(bottoms_m[used, 2])])
        if len(x_y) >= _FEWEST_FOR_TILT and spread_m >= _LEAST_SPREAD_M:
            slopes = np.linalg.lstsq(np.column_stack([x_y, np.ones(len(x_y))]), bottoms_m[used, 2], rcond=None)[0]
        distance_m = np.abs(bottoms_m[:, 2] - bottoms_m[:, :2] @ slopes[:2] - slopes[2])
        used = distance_m <= max(_OUTLIER * float(np.median(distance_m)), _BOTTOM_TOLERANCE_M)
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    length = float(np.sqrt((normal**2).sum()))
    return normal / length, float(-slopes[2] / length)


def _describe(plane: GroundPlane) -> str:
    return (
        f"The world is the ground plane of the sweeps, {plane.height_m:.2f} m below the sensor "
        f"(pitch {plane.pitch_deg:.2f}, roll {plane.roll_deg:.2f} degrees; {plane.returns:,} returns)."
    )


def in_scenario(scenario: Scenario, name: str | None, sensor: str | None) -> SensorSite:
    """Return a site of a scenario, with another sensor if one is named.

    Raises
    ------
    InputError
        If there is no such site, or several and none is named.
    """
    from egvs.sensors.scanner import Scanner
    from egvs.stages.inputs import Inputs

    scene = Inputs(scenario).plain_scene
    site = _choose(scene.sites, name)
    chosen = scene.sensor(sensor or site.sensor, "--sensor" if sensor else f"site {site.name}")
    scan = Scanner(scene, full_sweep=True).scan(site.pose, chosen).rows
    range_m = np.sqrt((scan.ends_m**2).sum(axis=1))
    return SensorSite(
        name=site.name,
        pose=site.pose,
        sensor=chosen,
        directions=scan.ends_m / range_m[:, None],
        range_m=range_m,
        beam=scan.beam.astype(np.int64),
        returned=scan.returned,
        weight=np.ones(len(range_m)) if scan.weight is None else scan.weight,
        assumptions=(f"The world is that of {scenario.name}, the pose that of its site {site.name}.",),
    )


def _choose(sites: Sequence[Site], name: str | None) -> Site:
    by_name = {site.name: site for site in sites}
    if name is None and len(sites) == 1:
        return sites[0]
    if name not in by_name:
        problem = f"expected one of {len(sites):,} sites, got {name!r}"
        raise InputError("--site", problem, f"Use --site {sites[0].name}.")
    return by_name[name]


def is_inverted(sensor: Sensor, scenario: Scenario | None) -> bool:
    """Return whether a scenario says that a sensor, or the sensors of all sites, hang upside down."""
    if scenario is None:
        return False
    own = scenario.sensors.get(sensor.name)
    return (scenario.sites.mount or ("upright" if own is None else own.mount)) == "inverted"


def find_sensor(name: str | None, scenario: Scenario | None) -> Sensor:
    """Return the sensor of sweeps that no site states; InputError for an unknown one, or none."""
    if name is None:
        problem = "expected the sensor of the sweeps, got none"
        hint = "Name one of egvs sensors, or one of [sensors] in a scenario; egvs sensor fit makes one of sweeps."
        raise InputError("--sensor", problem, hint)
    if scenario is not None:
        return scenario_sensor(name, scenario, "--sensor")
    return resolve_sensor(name, {}, "--sensor")
