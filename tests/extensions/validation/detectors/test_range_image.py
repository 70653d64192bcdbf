"""The ``range_image`` detector: scenes by hand, and rules that hold for every sweep."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from egvs.clouds.sweeps import SiteView, Sweep
from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.extensions.validation.detection_metrics import paired_overlap
from egvs.extensions.validation.detectors import base, range_image, segment_model
from egvs.extensions.validation.detectors.range_image import FEATURES, RangeImage, RangeImageAtSite
from egvs.extensions.validation.detectors.segment_model import MARGINS, SEGMENT_KINDS, BoostedTrees
from egvs.sensors.beam_files import BeamTable
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose

ROI = Roi((0.0, -20.0, 0.0), (40.0, 40.0, 5.0))
SENSOR = CATALOGUE["OS1-64"]
CAR = np.array([15.0, 2.0, 0.75, 4.5, 1.8, 1.5, 0.4])


def view_of(pose, sensor=SENSOR):
    """A sensor above level ground."""
    down = sensor.directions(*pose.angles_deg)[:, 2]
    with np.errstate(divide="ignore"):
        range_m = np.where(down < 0.0, -pose.z_m / down, np.inf)
    return SiteView("s", pose, sensor, np.where(range_m < sensor.range_m, range_m, np.inf))


def sweep_of(view, boxes):
    """The sweep of boxes on the ground: each beam ends on the nearest face that it enters."""
    ways = view.sensor.directions(*view.pose.angles_deg)
    range_m = view.empty_range_m.copy()
    for box in boxes:
        cos, sin = math.cos(box[6]), math.sin(box[6])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        start, way = turn @ (np.array(view.pose.position_m) - box[:3]), ways @ turn.T
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-box[3:6] / 2 - start) / way, (box[3:6] / 2 - start) / way
        near, far = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
        range_m = np.where((near < far) & (near > 0.0), np.minimum(range_m, near), range_m)
    beam = np.flatnonzero(np.isfinite(range_m))
    points = view.sensor.directions()[beam] * range_m[beam, None]
    return Sweep(np.column_stack([points, np.ones(len(beam))]).astype(np.float32), beam.astype(np.uint32))


@pytest.mark.slow
@pytest.mark.parametrize("pose", [Pose(0.0, 0.0, 5.0), Pose(0.0, 0.0, 5.0, 70.0, -8.0, 2.0)])
def test_car_seen_from_a_corner_gets_its_box(pose):
    """Two sides and the roof of a car give its whole length, width and height, so no margins are needed."""
    view = view_of(pose)
    site = RangeImageAtSite(view, ROI)
    segments = site.segments(sweep_of(view, [CAR]))
    boxes = site.boxes(segments, np.arange(len(segments)), np.zeros((len(segments), len(MARGINS))))
    overlap = paired_overlap(boxes, np.tile(CAR, (len(boxes), 1)))
    assert overlap.min(axis=0).max() > 0.8
    best = boxes[overlap[0].argmax()]
    assert abs(math.sin(best[6] - CAR[6])) < math.sin(math.radians(2.0))
    np.testing.assert_allclose(best[3:6], CAR[3:6], atol=0.4)  # rings meet the roof up to 0.4 m apart


def test_margins_extend_the_box_away_from_the_points():
    """Half a metre behind the far side along a, a quarter before the near side along b, 0.2 m of roof."""
    axes, ends = np.array([[1.0, 0.0, 0.0, 1.0]]), np.array([[10.0, 13.5, 2.0, 3.5]])
    features = np.zeros((1, len(FEATURES)))
    features[0, FEATURES.index("z_high_m")] = 1.3
    boxes = range_image.extended_boxes(axes, ends, features, np.array([[0.0, 0.5, 0.25, 0.0, 0.2]]))
    np.testing.assert_allclose(boxes, [[12.0, 2.625, 0.75, 4.0, 1.75, 1.5, 0.0]])


@pytest.mark.slow
def test_shipped_model_finds_a_car():
    view = view_of(Pose(0.0, 0.0, 5.0))
    detections = base.make_detector("range_image").at_site(view, ROI).detect(sweep_of(view, [CAR]))
    assert len(detections.boxes) == 1
    assert paired_overlap(detections.boxes, CAR[None])[0][0] > 0.7
    assert detections.scores[0] > 0.5


def test_segments_at_levels_join_a_queue_and_separate_it():
    """Cars 0.8 m apart: some segment has the points of one car only, some of both."""
    view = view_of(Pose(0.0, -6.0, 5.0))
    queue = [np.array([x, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0]) for x in (12.0, 17.3)]
    sweep = sweep_of(view, queue)
    segments = RangeImageAtSite(view, ROI).segments(sweep)
    points = sweep.points[:, :3].astype(np.float64) + view.pose.position_m
    extents = []
    for s in range(len(segments)):
        rows = segments.points[segments.starts[s] : segments.starts[s + 1]]
        extents.append((points[rows, 0].min(), points[rows, 0].max()))
    assert any(low < 11.0 and 14.0 < high < 14.4 for low, high in extents)
    assert any(15.0 < low < 15.5 and high > 18.0 for low, high in extents)
    assert any(low < 11.0 and high > 18.0 for low, high in extents)


def test_features_by_hand():
    """A wall of 3 m across the view, 10 m ahead and up to 2 m high."""
    view = view_of(Pose(0.0, 0.0, 3.0))
    wall = np.array([10.05, 0.0, 1.0, 0.1, 3.0, 2.0, 0.0])
    segments = RangeImageAtSite(view, ROI).segments(sweep_of(view, [wall]))
    row = dict(zip(FEATURES, segments.features[0].tolist(), strict=True))
    assert row["log_points"] == pytest.approx(math.log(segments.starts[1]))
    assert row["sensor_height_m"] == pytest.approx(3.0, abs=1e-6)
    assert row["range_m"] == pytest.approx(10.0, abs=0.1)
    assert row["length_a_m"] == pytest.approx(3.0, abs=0.15)
    assert row["z_high_m"] == pytest.approx(2.0, abs=0.15)
    assert abs(row["cos_view_a"]) < 0.05  # its longer side is across the line of sight
    assert row["hidden_low_a"] == row["hidden_high_a"] == 0.0  # nothing hides it


@pytest.mark.slow
def test_hidden_end_of_a_wall():
    view = view_of(Pose(0.0, 0.0, 3.0))
    wall, post = np.array([12.05, 0.0, 1.0, 0.1, 6.0, 2.0, 0.0]), np.array([6.0, 1.0, 1.5, 0.4, 0.8, 3.0, 0.0])
    segments = RangeImageAtSite(view, ROI).segments(sweep_of(view, [wall, post]))
    ends = segments.features[:, [FEATURES.index("hidden_low_a"), FEATURES.index("hidden_high_a")]]
    right_part = np.flatnonzero(np.isclose(segments.features[:, FEATURES.index("length_a_m")], 4.2, atol=0.4))
    assert len(right_part)  # y = -3 to about 1.2
    assert (ends[right_part].max(axis=1) > 0.2).all()  # of the points within 0.25 m of that side, those at the post
    assert (ends[right_part].min(axis=1) == 0.0).all()


# ---- any sweep


@pytest.mark.slow
def test_no_points_and_few_points_give_nothing():
    view = view_of(Pose(0.0, 0.0, 5.0))
    site = RangeImage().at_site(view, ROI)
    everything = sweep_of(view, [CAR])
    at_m = everything.points[:, :3].astype(np.float64) + view.pose.position_m
    new = np.flatnonzero((at_m[:, 2] > 0.5) & (np.abs(at_m[:, 0] - 15.0) < 2.0))
    for count in (0, 1, 3):
        rows = new[:count]
        assert len(site.detect(Sweep(everything.points[rows], everything.beam[rows])).boxes) == 0
    assert len(site.detect(sweep_of(view, [])).boxes) == 0


@pytest.mark.slow
def test_same_sweep_gives_same_boxes_after_others():
    view = view_of(Pose(0.0, 0.0, 5.0))
    site, sweep = RangeImage().at_site(view, ROI), sweep_of(view, [CAR])
    first = site.detect(sweep)
    site.detect(sweep_of(view, [np.add(CAR, [3.0, -5.0, 0, 0, 0, 0, 0.3])]))
    again = site.detect(sweep)
    np.testing.assert_array_equal(first.boxes, again.boxes)
    np.testing.assert_array_equal(first.scores, again.scores)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rejects_points_that_are_not_finite(value):
    view = view_of(Pose(0.0, 0.0, 5.0))
    sweep = sweep_of(view, [CAR])
    sweep.points[7, 1] = value
    with pytest.raises(InputError, match="site s: expected finite points, got NaN or infinity"):
        RangeImage().at_site(view, ROI).detect(sweep)


def test_rejects_beams_of_another_sensor():
    view = view_of(Pose(0.0, 0.0, 5.0))
    sweep = Sweep(np.ones((1, 4), dtype=np.float32), np.array([SENSOR.beams], dtype=np.uint32))
    with pytest.raises(InputError, match=f"expected beams 0 to {SENSOR.beams - 1}, got {SENSOR.beams}"):
        RangeImage().at_site(view, ROI).detect(sweep)


# ---- neighbours of beams


def neighbours_of(graph, beam):
    return sorted(graph.neighbours[graph.starts[beam] : graph.starts[beam + 1]].tolist())


def test_neighbours_in_rings():
    """Beams before and after in the ring, and the nearest beam of the rings above and below."""
    graph = range_image.beam_graph(CATALOGUE["OS1-64"])
    sensor = CATALOGUE["OS1-64"]
    direction = sensor.directions()
    for beam in (0, 5, 63, 64 * 100 + 30, sensor.beams - 1):
        near = neighbours_of(graph, beam)
        azimuth, ring = divmod(beam, sensor.channels)
        for step in (-1, 1):
            assert (azimuth + step) % sensor.azimuths * sensor.channels + ring in near
        others = [other for other in near if other % sensor.channels != ring]
        assert len(others) == (1 if sensor.elevations_deg[ring] in sensor.elevation_span_deg else 2)
        for other in others:  # no beam of that ring is nearer
            of_ring = np.arange(other % sensor.channels, sensor.beams, sensor.channels)
            cosine = direction[of_ring] @ direction[beam]
            assert direction[other] @ direction[beam] >= cosine.max() - 1e-6


@pytest.mark.slow
def test_graph_is_symmetric_and_joins_beams_within_8_degrees():
    for name in ("VLP-16", "RS-M1", "Livox HAP"):
        sensor = CATALOGUE[name]
        graph = range_image.beam_graph(sensor)
        first = np.repeat(np.arange(sensor.beams), np.diff(graph.starts))
        pairs = set(zip(first.tolist(), graph.neighbours.tolist(), strict=True))
        assert all((b, a) in pairs for a, b in pairs)
        assert (first != graph.neighbours).all()
        directions = sensor.directions()
        cosine = np.einsum("ij,ij->i", directions[first], directions[graph.neighbours])
        assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() <= 8.0 + 1e-6
        assert (np.diff(graph.starts) > 0).mean() > 0.99


def test_neighbours_of_a_table():
    """Four beams in a square and one of equal direction; and beams on one line."""
    square = BeamTable(np.array([0.0, 0.0, 1.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0, 1.0]))
    graph = range_image.beam_graph(table_sensor(square))
    assert {1, 2} <= set(neighbours_of(graph, 0))
    assert 4 in neighbours_of(graph, 3) or 3 in neighbours_of(graph, 4)
    line = range_image.beam_graph(table_sensor(BeamTable(np.zeros(4), np.array([3.0, 1.0, 0.0, 2.0]))))
    assert [neighbours_of(line, beam) for beam in range(4)] == [[3], [2, 3], [1], [0, 1]]


def table_sensor(table):
    return replace(CATALOGUE["RS-M1"], table=table)


# ---- the model


def test_trees_by_hand():
    """One tree: x0 <= 1 gives 10; else x1 <= 2 gives 20, above it 30; and a base of 0.5."""
    tree = [[0, -1, 1, -1, -1], [1.0, 0, 2.0, 0, 0], [1, 0, 3, 0, 0], [2, 0, 4, 0, 0], [0, 10, 0, 20, 30]]
    trees = BoostedTrees.from_json({"base": 0.5, "trees": [tree, tree]})
    features = np.array([[1.0, 9.0], [1.1, 2.0], [5.0, 2.1]])
    np.testing.assert_allclose(trees.predict(features), [20.5, 40.5, 60.5])


def test_shipped_model_says_how_it_was_made():
    content = json.loads(segment_model.MODEL_FILE.read_text(encoding="utf-8"))
    about = content["about"]
    assert about["made_by"] == "python -m benchmarks.range_image_model"
    assert about["junctions"] == ["ingolstadt", "hill", "roundabout"]  # training junctions only
    assert len(about["sensors"]) == 12
    assert set(about["sensors"]) <= set(CATALOGUE)
    assert about["features"] == list(FEATURES)


@pytest.mark.parametrize("text", ["", "{}", '{"kinds": {}, "margins": 1}'])
def test_rejects_file_that_is_no_model(tmp_path, text):
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(InputError, match="expected a model of segments"):
        segment_model.read_model(path)


def test_probabilities_of_known_logarithms():
    trees = [BoostedTrees.from_json({"base": math.log(weight), "trees": []}) for weight in (1.0, 2.0, 3.0, 4.0, 10.0)]
    model = replace(segment_model.read_model(), kinds=tuple(trees))
    features = np.zeros((2, len(FEATURES)))
    np.testing.assert_allclose(model.kind_probabilities(features), [[0.05, 0.1, 0.15, 0.2, 0.5]] * 2)
    assert model.kind_probabilities(features[:0]).shape == (0, len(SEGMENT_KINDS))
