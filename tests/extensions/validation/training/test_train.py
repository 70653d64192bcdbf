"""Training: samples and their targets, the loss, the exported model, resuming."""

import json
import math

import numpy as np
import pytest

pytest.importorskip("torch", reason="PyTorch is not installed: make test-train")

import onnx
import torch

from egvs import load
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.sweeps import SiteView
from egvs.core.errors import InputError
from egvs.extensions.validation.detectors import pointpillars
from egvs.extensions.validation.detectors.pointpillars import (
    METADATA_KEY,
    N_FEATURES,
    POINTS_PER_PILLAR,
    HeightOrigin,
    OnnxModel,
    Pillars,
    PillarWindow,
    PointPillars,
)
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.extensions.validation.training import pillar_net, samples
from egvs.extensions.validation.training.pillar_net import Batch, PillarNet, compute_loss
from egvs.extensions.validation.training.samples import CROP_CELLS, Sample, Samples, TrainingJunction
from egvs.extensions.validation.training.train import Recipe
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose

SENSOR = CATALOGUE["VLP-16"]
VIEW = SiteView("s", Pose(0.0, 0.0, 5.0), SENSOR, np.full(SENSOR.beams, np.inf))


def _target(boxes, points, kinds=None):
    frame = TrafficFrame(0, ("v",) * len(boxes), kinds or ("passenger",) * len(boxes), np.array(boxes), np.zeros(2))
    zero = HeightOrigin("sensor", [VIEW], None)  # heights from 5 m
    motor = np.array([kind != "pedestrian" for kind in frame.kinds])
    return samples.make_target(frame, motor, np.array(points), PillarWindow((0.0, 0.0), 0.0, CROP_CELLS), zero)


def test_target_has_visible_vehicles_and_ignores_barely_visible_ones():
    visible, hardly = [1.0, 2.0, 4.25, 4.5, 1.8, 1.5, 0.3], [10.0, -12.0, 4.0, 4.5, 1.8, 1.5, 0.0]
    target = _target([visible, hardly], [3, 2])
    half = CROP_CELLS * 0.4 / 2
    cell = tuple(np.floor((np.array(visible[:2]) + half) / 0.8).astype(int))
    assert target.heat[cell] == 1.0 and (target.heat == 1.0).sum() == 1
    np.testing.assert_array_equal(target.cell, [cell])
    np.testing.assert_allclose(
        target.values[0, 2:], [-0.75, *np.log(visible[3:6]), math.sin(0.6), math.cos(0.6)], rtol=1e-6
    )
    other = tuple(np.floor((np.array(hardly[:2]) + half) / 0.8).astype(int))
    assert target.loss_weight[other] == 0.0 and target.loss_weight[cell] == 1.0
    assert _target([visible, hardly], [3, 0]).loss_weight.all()  # nobody can see it: an empty place


def test_mirrored_sample_equals_sample_of_mirrored_street():
    visible = [1.0, 2.0, 0.75, 4.5, 1.8, 1.5, 0.3]
    mirrored_box = [1.0, -2.0, 0.75, 4.5, 1.8, 1.5, -0.3]
    features = np.random.default_rng(0).normal(size=(3, POINTS_PER_PILLAR, N_FEATURES)).astype(np.float32)
    pillars = Pillars(features, np.ones((3, POINTS_PER_PILLAR), np.float32), np.array([5, 300, 301]))

    class Tails:
        def random(self):
            return 0.9

    was = Sample(pillars, _target([visible, visible], [5, 0]))
    now = samples.randomly_mirrored(was, Tails())
    want = _target([mirrored_box, mirrored_box], [5, 0])
    np.testing.assert_allclose(now.target.heat, want.heat, atol=1e-6)
    np.testing.assert_array_equal(now.target.cell, want.cell)
    np.testing.assert_allclose(now.target.values, want.values, atol=1e-5)
    np.testing.assert_array_equal(now.pillars.cell, sorted([127 - 5, 2 * 128 + 127 - 44, 2 * 128 + 127 - 45]))
    back = samples.randomly_mirrored(now, Tails())
    np.testing.assert_array_equal(back.pillars.features, pillars.features)


def test_loss_of_known_case():
    target = _target([[1.0, 2.0, 5.0, 4.5, 1.8, 1.5, 0.0], [0, 0, 0, 1, 1, 1, 0.0]], [3, 0])
    pillars = Pillars(
        np.zeros((1, POINTS_PER_PILLAR, N_FEATURES), np.float32),
        np.ones((1, POINTS_PER_PILLAR), np.float32),
        np.array([0]),
    )
    batch = Batch.collate([Sample(pillars, target)])
    odds = torch.full((1, 1, 64, 64), -20.0)  # certainly no vehicle anywhere
    values = torch.zeros((1, pointpillars.N_VALUES, 64, 64))
    middles, boxes = compute_loss(odds, values, batch)
    assert middles.item() == pytest.approx(20.0, abs=1e-4)  # -(1 - 0)^2 log(e^-20)
    assert boxes.item() == pytest.approx(0.5 * np.abs(target.values).sum(), rel=1e-5)
    odds[0, 0, target.cell[0, 0], target.cell[0, 1]] = 20.0
    values[0, :, target.cell[0, 0], target.cell[0, 1]] = torch.from_numpy(target.values[0])
    middles, boxes = compute_loss(odds, values, batch)
    assert middles.item() == pytest.approx(0.0, abs=1e-6) and boxes.item() == 0.0


def test_exported_model_equals_network(tmp_path):
    torch.manual_seed(0)
    net = PillarNet()
    path = tmp_path / "m.onnx"
    path.write_bytes(pillar_net.export_onnx(net, {"convention": "ground", "note": "é"}))
    model = OnnxModel.load(path)
    assert model.metadata == {"convention": "ground", "note": "é"}
    net.eval()
    for pillars in (1, 37):
        feed = {
            "features": np.random.default_rng(1)
            .normal(size=(pillars, POINTS_PER_PILLAR, N_FEATURES))
            .astype(np.float32),
            "present": np.ones((pillars, POINTS_PER_PILLAR), np.float32),
            "cell": np.arange(pillars) * 11,
        }
        heat, values = model.session.run(None, feed)
        with torch.no_grad():
            want_heat, want_values = net(*(torch.from_numpy(part) for part in feed.values()))
        np.testing.assert_allclose(heat, want_heat.numpy(), atol=1e-4)
        np.testing.assert_allclose(values, want_values.numpy(), atol=1e-4)
    assert net.training is False


def test_rejects_models_of_other_shapes(tmp_path):
    path = tmp_path / "m.onnx"
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, ["n", 3])
    out = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, ["n", 3])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "g", [value], [out])
    opset = [onnx.helper.make_opsetid("", 18)]
    path.write_bytes(onnx.helper.make_model(graph, opset_imports=opset, ir_version=9).SerializeToString())
    with pytest.raises(InputError, match=r"m\.onnx: expected a model with inputs .*'x': \[3\]"):
        OnnxModel.load(path)
    good = onnx.load_from_string(pillar_net.export_onnx(PillarNet(), {"convention": "ground"}))
    del good.metadata_props[:]
    path.write_bytes(good.SerializeToString())
    with pytest.raises(InputError, match="its metadata has no valid height convention"):
        OnnxModel.load(path)


def test_sample_depends_on_its_number_only(mini, tmp_path):
    scenario = load(mini, ["sensors.small.channels=32"])
    junction = TrainingJunction(prepare_held_out_traffic(scenario, tmp_path / "r", 10), (3.0, 4.0))
    first, again = (Samples([junction], ["small"], "ground", 5) for _ in range(2))
    forward = [first.sample(i) for i in range(10)]
    for i in reversed(range(10)):
        sample = again.sample(i)
        np.testing.assert_array_equal(sample.pillars.features, forward[i].pillars.features)
        np.testing.assert_array_equal(sample.target.heat, forward[i].target.heat)
    assert any(len(sample.target.cell) for sample in forward)


@pytest.mark.filterwarnings("ignore")  # of PyTorch's exporter, about itself
def test_training_resumes_and_writes_metadata(mini, tmp_path, monkeypatch):
    scenario = load(mini, ["sensors.small.channels=32"])
    recipe = Recipe(steps=4, frames=10, heights_m=(3.0, 4.0), sensors=("small",), look_every=4)
    from egvs.extensions.validation.training import train
    from egvs.extensions.validation.training.train import HeldOutSet

    monkeypatch.setattr(HeldOutSet, "FRAMES", 10)
    monkeypatch.setattr(train, "_CHECKPOINT_STEPS", 2)
    complete = train.train([scenario], tmp_path / "whole.onnx", recipe)
    assert [entry["step"] for entry in complete["curve"]] == [4]
    assert complete["junctions"] == [scenario.name] and complete["recipe"]["steps"] == 4

    class Stop(Exception):
        pass

    def stop(what, done, total):
        if what == "steps learned" and done == 3:
            raise Stop

    with pytest.raises(Stop):
        train.train([scenario], tmp_path / "part.onnx", recipe, progress=stop)
    assert not (tmp_path / "part.onnx").exists() and (tmp_path / "part.onnx.partial").exists()
    with pytest.raises(InputError, match="the checkpoint belongs to another training"):
        train.train([scenario], tmp_path / "part.onnx", Recipe(steps=5, frames=10, sensors=("small",)))
    train.train([scenario], tmp_path / "part.onnx", recipe)
    assert not (tmp_path / "part.onnx.partial").exists()
    assert (tmp_path / "part.onnx").read_bytes() == (tmp_path / "whole.onnx").read_bytes()
    metadata = json.loads({p.key: p.value for p in onnx.load(tmp_path / "whole.onnx").metadata_props}[METADATA_KEY])
    assert metadata["parameters"] == 985785
    assert PointPillars(tmp_path / "whole.onnx").settings["model"]
