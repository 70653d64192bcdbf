"""Train the model of the detector ``range_image`` on simulated sweeps of the training junctions.

``python -m benchmarks.range_image_model`` writes ``pipeline/egvs/extensions/validation/detectors/range_image.json``:
ingolstadt, hill and roundabout, twelve sensors, random poses, and traffic with a seed that nothing else
uses. The same seed gives the same file. It takes some five minutes on one core. ``--out`` writes elsewhere,
``--junction`` trains on some of the junctions: ``--junction hill,roundabout`` for a test at ingolstadt.

Steps: simulate sweeps; find their segments, as the detector does; label each segment with the road users that its
points are on (:func:`label_segments`); fit trees for kinds and margins on half of the poses, and measure the boxes that
they give on the other half, and vice versa; fit the confidence to these results; fit kinds and margins on all poses.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor

import egvs
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import CloudSimulator
from egvs.core import files
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.extensions.validation.detection_metrics import paired_overlap
from egvs.extensions.validation.detector_results import frame_classes
from egvs.extensions.validation.detectors import range_image, segment_model
from egvs.extensions.validation.detectors.range_image import FEATURES, RangeImageAtSite, Segments, box_features
from egvs.extensions.validation.detectors.segment_model import MARGINS, SEGMENT_KINDS, VEHICLE_KINDS, SegmentModel
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.extensions.validation.training.samples import TrainingJunction
from egvs.sensors.sensor import CATALOGUE

SCENARIOS = Path(__file__).parents[1] / "scenarios"
JUNCTIONS = ("ingolstadt", "hill", "roundabout")
SENSORS = (
    "VLP-16", "VLP-32C", "Pandar XT-32", "AT128", "Pandar128", "RS-Ruby Plus", "RS-M1", "OS1-64", "OS1-128", "OS0-128",
    "Livox Tele-15", "Livox HAP",
)  # fmt: skip
"""Sensors that the shipped model was trained on."""
HEIGHTS_M = (2.0, 8.0)
FRAMES, SPACING_S = 60, 7.0
"""Frames of each junction's traffic, and the time between two of them."""

_STREAM = 0x5E63
"""Makes the seed of this traffic differ from that of any evaluation."""

KIND_OF_CLASS = {
    "Car": "car", "Van": "van", "Truck": "long", "Trailer": "long", "Bus": "long", "Tram": "long", "Misc": "long",
    "Motorcycle": "other", "Cyclist": "other", "Pedestrian": "other",
}  # fmt: skip

SINGLE_SHARE = 0.9
"""A segment is of one road user if so many of its points are."""

MAX_TURN_RAD = np.radians(8.0)
"""Margins are learnt from rectangles whose heading is right up to this."""

OVERLAPS = (0.5, 0.7)
DIGITS = 5


class Examples(NamedTuple):
    """Labelled segments of many sweeps, n of them.

    Attributes
    ----------
    features, axes, ends_m
        As the detector computes them, (n, f), (n, 4) and (n, 4) float64.
    kind
        Index into ``SEGMENT_KINDS``, (n,) int64.
    margins_m
        What the model should predict, (n, 5) float64; NaN where a segment is of no single vehicle, or turned.
    truth
        Boxes of the two road users with most points in the segment, from the sensor in plan and from the ground in
        height, (n, 2, 7) float64; NaN where there is no vehicle.
    half
        0 or 1: half of the poses, (n,) int64.
    """

    features: FloatArray
    axes: FloatArray
    ends_m: FloatArray
    kind: IntArray
    margins_m: FloatArray
    truth: FloatArray
    half: IntArray

    @classmethod
    def joined(cls, parts: Iterable[Examples]) -> Examples:
        """Return all examples of several parts."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def label_segments(
    segments: Segments, owner: IntArray, frame: TrafficFrame, site: RangeImageAtSite
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return kind, margins and true boxes of segments, as in :class:`Examples`.

    Parameters
    ----------
    owner
        Row of the frame's boxes that each point of the sweep lies on, -1 on the static world, (points,).
    """
    count = len(segments)
    kind = np.full(count, SEGMENT_KINDS.index("other"), dtype=np.int64)
    margins_m, truth = np.full((count, len(MARGINS)), np.nan), np.full((count, 2, 7), np.nan)
    classes, is_vehicle = frame_classes(frame), frame.are_vehicles()
    for s in range(count):
        owners, points = np.unique(
            owner[segments.points[segments.starts[s] : segments.starts[s + 1]]], return_counts=True
        )
        order = np.argsort(-points, kind="stable")
        first = int(owners[order[0]])
        for place, row in enumerate(owners[order[:2]].tolist()):
            if row >= 0 and is_vehicle[row]:
                truth[s, place] = _from_sensor(frame.boxes[row], site)
        if points[order[0]] < SINGLE_SHARE * points.sum():
            kind[s] = SEGMENT_KINDS.index("several")
        elif first >= 0:
            kind[s] = SEGMENT_KINDS.index(KIND_OF_CLASS[classes[first]])
            if kind[s] < len(VEHICLE_KINDS):
                margins_m[s] = _true_margins_m(segments, s, truth[s, 0])
    return kind, margins_m, truth


def _from_sensor(box: FloatArray, site: RangeImageAtSite) -> FloatArray:
    """Return a box of the world frame from the sensor in plan and from the ground in height, (7,)."""
    moved = box.copy()
    moved[:2] -= np.asarray(site.view.pose.position_m[:2])
    moved[2] -= site.ground.height_m(box[None, :2])[0]
    return moved


def _true_margins_m(segments: Segments, s: int, box: FloatArray) -> FloatArray:
    """Return the margins that give a box from the sensor, (5,); NaN where the rectangle is turned."""
    axes, (low_a, high_a, low_b, high_b) = segments.axes[s].reshape(2, 2), segments.ends_m[s]
    turn = box[6] - np.arctan2(axes[0, 1], axes[0, 0])
    quarter = round(turn / (np.pi / 2.0))
    if abs(turn - quarter * np.pi / 2.0) > MAX_TURN_RAD:
        return np.full(len(MARGINS), np.nan)
    along_a, along_b = (box[3], box[4]) if quarter % 2 == 0 else (box[4], box[3])
    middle_a, middle_b = axes @ box[:2]
    top_m = box[5] - segments.features[s, FEATURES.index("z_high_m")]
    return np.array(
        [
            low_a - (middle_a - along_a / 2.0),
            middle_a + along_a / 2.0 - high_a,
            low_b - (middle_b - along_b / 2.0),
            middle_b + along_b / 2.0 - high_b,
            top_m,
        ]
    )


def simulate_examples(name: str, sensors: Sequence[str], poses: int, frames: int, seed: int, folder: Path) -> None:
    """Simulate sweeps of a junction with some sensors; write their labelled segments as ``JUNCTION SENSOR.npz``.

    Parameters
    ----------
    poses, frames
        Poses of each sensor, and frames at each pose.
    """
    with tempfile.TemporaryDirectory() as work:
        scenario = egvs.load(SCENARIOS / name)
        state = np.random.SeedSequence((scenario.seed, _STREAM, seed)).generate_state(1, np.uint64)
        reseeded = scenario.model_copy(update={"seed": int(state[0]) >> 33})
        record = prepare_held_out_traffic(reseeded, Path(work), FRAMES, apart_s=SPACING_S, jobs=1)
        junction = TrainingJunction(record, HEIGHTS_M)
        for sensor in sensors:
            parts: list[Examples] = []
            for pose in range(poses):
                stream = (seed, JUNCTIONS.index(name), SENSORS.index(sensor), pose)
                rng = np.random.default_rng(np.random.SeedSequence(stream))
                parts += _pose_examples(junction, sensor, rng, frames, pose % 2)
            examples = Examples.joined(parts)
            with files.atomic_write(_part_path(folder, name, sensor)) as partial, partial.open("wb") as out:
                np.savez_compressed(out, **examples._asdict())
            print(f"{name}, {sensor}: {len(examples.kind)} segments", flush=True)


def _part_path(folder: Path, name: str, sensor: str) -> Path:
    return folder / f"{name} {sensor}.npz"


def _pose_examples(
    junction: TrainingJunction, sensor: str, rng: np.random.Generator, frames: int, half: int
) -> Iterator[Examples]:
    """Yield the examples of some frames from one random pose."""
    scene = junction.record.scene
    pose = junction.draw_pose(CATALOGUE[sensor], rng)
    simulator = CloudSimulator(scene, pose, CATALOGUE[sensor], "random pose", junction.scanner)
    site = RangeImageAtSite(simulator.view, scene.roi)
    for row in rng.choice(len(junction.frames), frames, replace=False).tolist():
        frame = junction.frames[row]
        cloud = simulator.sweep(frame, rng)
        segments = site.segments(cloud.sweep)
        labels = label_segments(segments, cloud.owner.astype(np.int64), frame, site)
        yield Examples(segments.features, segments.axes, segments.ends_m, *labels, np.full(len(segments), half))


# ---- fitting


def fit_kinds_and_margins(examples: Examples, rows: BoolArray) -> dict[str, Any]:
    """Return the trees for kinds and margins, fitted to some examples, in the format of the file."""

    classifier = HistGradientBoostingClassifier(
        max_iter=30, learning_rate=0.2, max_leaf_nodes=12, min_samples_leaf=40, early_stopping=False, random_state=0
    ).fit(examples.features[rows], examples.kind[rows])
    base = np.ravel(classifier._baseline_prediction)
    kinds = {}
    for column, label in enumerate(classifier.classes_.tolist()):
        trees = [_tree(predictors[column].nodes) for predictors in classifier._predictors]
        kinds[SEGMENT_KINDS[label]] = {"base": _short(base[column]), "trees": trees}
    margins: dict[str, Any] = {}
    for number, kind in enumerate(VEHICLE_KINDS):
        used = rows & (examples.kind == number) & np.isfinite(examples.margins_m[:, 0])
        margins[kind] = {}
        for column, name in enumerate(MARGINS):
            margins[kind][name] = _fit_sum(
                examples.features[used], examples.margins_m[used, column], loss="absolute_error", trees=30, leaves=10
            )
    return {"kinds": kinds, "margins": margins}


def _fit_sum(features: FloatArray, target: FloatArray, *, loss: str, trees: int, leaves: int) -> dict[str, Any]:
    regressor = HistGradientBoostingRegressor(
        loss=loss, max_iter=trees, learning_rate=0.2, max_leaf_nodes=leaves, min_samples_leaf=30,
        early_stopping=False, random_state=0,
    ).fit(features, target)  # fmt: skip
    base = _short(np.ravel(regressor._baseline_prediction)[0])
    return {"base": base, "trees": [_tree(predictors[0].nodes) for predictors in regressor._predictors]}


def _tree(nodes: Any) -> list[list[float]]:
    """Return the nodes of a tree as five columns; -1 is the feature of a leaf."""
    columns: list[list[float]] = [[], [], [], [], []]
    for node in nodes:
        if node["is_leaf"]:
            row = [-1, 0, 0, 0, _short(node["value"])]
        else:
            row = [int(node["feature_idx"]), _short(node["num_threshold"]), int(node["left"]), int(node["right"]), 0]
        for column, value in zip(columns, row, strict=True):
            column.append(value)
    return columns


def _short(value: float) -> float:
    return float(f"{float(value):.{DIGITS}g}")


def right_share(boxes: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the share of views and of :data:`OVERLAPS` in which boxes (n, 7) match one of two (n, 2, 7), (n,)."""
    best = np.zeros((2, len(boxes)))
    for place in range(2):
        rows = np.flatnonzero(np.isfinite(truth[:, place, 0]))
        best[:, rows] = np.maximum(best[:, rows], paired_overlap(boxes[rows], truth[rows, place]))
    shares: FloatArray = np.mean([(best > overlap).mean(axis=0) for overlap in OVERLAPS], axis=0)
    return shares


def fit_model(examples: Examples) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the content of the file, and results on the halves of the poses that were not fitted."""
    probabilities = np.zeros((len(examples.kind), len(SEGMENT_KINDS)))
    margins_m = np.zeros((len(examples.kind), len(MARGINS)))
    for half in range(2):
        fitted = examples.half == half
        content = {**fit_kinds_and_margins(examples, fitted), "confidence": {"base": 0.0, "trees": []}}
        model = SegmentModel.from_json(content)
        other = np.flatnonzero(~fitted)
        probabilities[other] = model.kind_probabilities(examples.features[other])
        likely = probabilities[other, : len(VEHICLE_KINDS)].argmax(axis=1)
        margins_m[other] = model.margins_m(examples.features[other], likely)
    boxes = range_image.extended_boxes(examples.axes, examples.ends_m, examples.features, margins_m)
    share = right_share(boxes, examples.truth)
    is_candidate = probabilities[:, : len(VEHICLE_KINDS)].sum(axis=1) >= range_image.MIN_VEHICLE_PROBABILITY
    features = np.column_stack([examples.features, box_features(probabilities, boxes, margins_m)])
    confidence = _fit_sum(features[is_candidate], share[is_candidate], loss="squared_error", trees=60, leaves=16)
    is_vehicle = np.isfinite(examples.margins_m[:, 0])
    error_m = np.abs(margins_m - examples.margins_m)[is_vehicle]
    results = {
        "kind_is_right": float((probabilities.argmax(axis=1) == examples.kind).mean()),
        "median_error_of_margins_m": float(np.median(error_m)),
        "mean_share_of_right_boxes": float(share[is_candidate].mean()),
    }
    content = {**fit_kinds_and_margins(examples, np.ones(len(examples.kind), dtype=np.bool_)), "confidence": confidence}
    return content, {name: round(value, 4) for name, value in results.items()}


def file_text(about: dict[str, Any], content: dict[str, Any]) -> str:
    """Return the text of the file; each tree has its own line."""

    def render(value: Any, indent: str) -> str:
        if isinstance(value, dict):
            inner = ",\n".join(f'{indent} "{key}": {render(entry, indent + " ")}' for key, entry in value.items())
            return f"{{\n{inner}\n{indent}}}"
        if isinstance(value, list) and value and isinstance(value[0], list) and isinstance(value[0][0], list):
            return "[\n" + ",\n".join(indent + " " + json.dumps(tree, separators=(",", ":")) for tree in value) + "]"
        return json.dumps(value)

    return render({"about": about, **content}, "") + "\n"


def main() -> None:
    """Train, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--junction", default=",".join(JUNCTIONS), help="training junctions, separated by commas")
    parser.add_argument("--poses", type=int, default=3, help="poses of each sensor at each junction")
    parser.add_argument("--frames", type=int, default=8, help="frames at each pose")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=segment_model.MODEL_FILE)
    parser.add_argument(
        "--parts",
        type=Path,
        help="folder of simulated parts; those that are there are used, so a stopped run continues",
    )
    options = parser.parse_args()
    junctions = options.junction.split(",")
    for name in junctions:
        if name not in JUNCTIONS:
            parser.error(f"--junction: expected training junctions ({', '.join(JUNCTIONS)}), got {name}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if options.parts is not None:
            folder = options.parts / f"{options.poses} poses, {options.frames} frames, seed {options.seed}"
            folder.mkdir(parents=True, exist_ok=True)
        for name in junctions:
            missing = [sensor for sensor in SENSORS if not _part_path(folder, name, sensor).is_file()]
            if missing:
                simulate_examples(name, missing, options.poses, options.frames, options.seed, folder)
        paths = [_part_path(folder, name, sensor) for name in junctions for sensor in SENSORS]
        examples = Examples.joined(Examples(**np.load(path)) for path in paths)
    content, results = fit_model(examples)
    about = {
        "made_by": "python -m benchmarks.range_image_model",
        "junctions": junctions,
        "sensors": list(SENSORS),
        "poses": options.poses,
        "frames": options.frames,
        "seed": options.seed,
        "segments": len(examples.kind),
        "of_kind": {kind: int((examples.kind == number).sum()) for number, kind in enumerate(SEGMENT_KINDS)},
        "on_other_poses": results,
        "features": list(FEATURES),
        "scikit_learn": importlib.metadata.version("scikit-learn"),
    }
    with files.atomic_write(options.out) as partial:
        partial.write_text(file_text(about, content), encoding="utf-8")
    print(json.dumps(results), f"{options.out} {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
