"""What errors of a sensor's pose do to detection: of its installation, and of what the detector believes.

``python -m benchmarks.pose_errors [SCENARIO...]``: for each scenario (by default the training junctions roundabout and
hill), the detector ``cluster`` runs at all sites on the same 200 frames of held-out traffic.

*Installed elsewhere*: every sensor stands 0.1 m from where it was planned, in a random direction, and its yaw, pitch
and roll differ by 1 degree, each way at random. The detector knows where it is; only the scores were computed for the
plan. *Badly calibrated*: every sensor stands as planned, but the detector's boxes are where they would be if the pose
had these errors: the centre and the heading of a box turn and move with the pose, and the box stays upright, with its
size (a detector would fit its boxes to tilted points, a matter of centimetres). The empty scan is measured, so it has
no error. Detections are cut to the region of interest before they move, so boxes that would move in are missing: at
50 m, those of a strip of 0.9 m.

Prints the same columns as :mod:`benchmarks.realism`; the score is that of the planned poses. Each of ``--draws`` draws
is a row; standard errors are those of the frames.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import egvs
from benchmarks.across_junctions.candidates import with_sites
from benchmarks.realism import (
    DETECTOR,
    FRAMES,
    HEADING,
    SCENARIOS,
    TRAFFIC_FRAMES,
    SiteDetections,
    planned_scores,
    table_row,
)
from egvs.clouds.sweeps import Detections
from egvs.core.grid import FloatArray, Roi
from egvs.extensions.validation.detector_results import DetectedBoxes, detections_in_roi
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose

SEED, DRAWS = 3703, 3
POSITION_M, ANGLE_DEG = 0.1, 1.0


def with_error(pose: Pose, rng: np.random.Generator) -> Pose:
    """Return a pose that is :data:`POSITION_M` away, and whose angles differ by :data:`ANGLE_DEG`, at random."""
    direction = rng.normal(size=3)
    x_m, y_m, z_m = np.asarray(pose.position_m) + POSITION_M * direction / np.linalg.norm(direction)
    yaw_deg, pitch_deg, roll_deg = np.asarray(pose.angles_deg) + rng.choice([-ANGLE_DEG, ANGLE_DEG], 3)
    return Pose(float(x_m), float(y_m), float(z_m), float(yaw_deg), float(pitch_deg), float(roll_deg))


def move_boxes(boxes: FloatArray, pose: Pose, believed: Pose) -> FloatArray:
    """Return boxes (m, 7) where a detector puts them that believes another pose than that of the sensor."""
    turn = rotation_world_sensor(*believed.angles_deg) @ rotation_world_sensor(*pose.angles_deg).T
    heading = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))]) @ turn.T
    moved = boxes.copy()
    moved[:, :3] = (boxes[:, :3] - pose.position_m) @ turn.T + believed.position_m
    moved[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    return moved


def badly_calibrated(planned: SiteDetections, believed: dict[str, Pose]) -> SiteDetections:
    """Return the detections that believe other poses."""
    results = {}
    for site in planned.sites:
        found = planned.results[site.name][DETECTOR]
        assert isinstance(found, DetectedBoxes)
        frames = tuple(_moved(frame, site.pose, believed[site.name], planned.roi) for frame in found.frames)
        results[site.name] = {**planned.results[site.name], DETECTOR: DetectedBoxes(frames)}
    return replace(planned, results=results)


def _moved(frame: Detections, pose: Pose, believed: Pose, roi: Roi) -> Detections:
    return detections_in_roi(Detections(move_boxes(frame.boxes, pose, believed), frame.scores), roi)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pose_errors", description=__doc__.split("\n")[0])
    parser.add_argument("scenarios", type=Path, nargs="*", default=[SCENARIOS / "roundabout", SCENARIOS / "hill"])
    parser.add_argument("--out", type=Path, default=Path("runs") / "pose_errors")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--draws", type=int, default=DRAWS)
    given = parser.parse_args()
    print(HEADING.format("error of 0.1 m and 1°"))
    for path in given.scenarios:
        scenario = egvs.load(path, [f"traffic.frames={TRAFFIC_FRAMES}", "effects.range_limit=false"])
        out = given.out / scenario.name
        score = planned_scores(scenario, out)
        planned = SiteDetections.measure(scenario, out, given.frames)
        plain = planned.ap_by_site()
        print(table_row((scenario.name, "none"), plain, plain, score, given.frames), flush=True)
        for draw in range(given.draws):
            rng = np.random.default_rng((SEED, draw))
            poses = {site.name: with_error(site.pose, rng) for site in planned.sites}
            moved = [replace(site, pose=poses[site.name]) for site in planned.sites]
            elsewhere = SiteDetections.measure(with_sites(scenario, moved, out / "moved.csv"), out, given.frames)
            for name, detections in (
                ("installed elsewhere", elsewhere),
                ("badly calibrated", badly_calibrated(planned, poses)),
            ):
                ap = detections.ap_by_site()
                print(table_row((scenario.name, name), ap, plain, score, given.frames), flush=True)


if __name__ == "__main__":
    main()
