"""Writes a network as an ONNX model that says how it was made."""

from __future__ import annotations

import json
import warnings
from typing import Any

import onnx
import torch

from pipeline.validation.detectors.pointpillars.detector import ABOUT
from pipeline.validation.detectors.pointpillars.encoding import FEATURES, POINTS
from pipeline.validation.training.network import PillarNet

_PILLARS = 8  # of the example that the export traces; any number will do


def to_bytes(net: PillarNet, about: dict[str, Any]) -> bytes:
    """The model, its description under :data:`ABOUT`. The network is left in training mode as it was."""
    was_training = net.training
    net.eval()
    example = (torch.zeros(_PILLARS, POINTS, FEATURES), torch.ones(_PILLARS, POINTS), torch.arange(_PILLARS))
    pillars = torch.export.Dim("pillars", min=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about itself
        program = torch.onnx.export(
            net,
            example,
            input_names=["features", "present", "cell"],
            output_names=["heat", "values"],
            dynamic_shapes={"features": {0: pillars}, "present": {0: pillars}, "cell": {0: pillars}},
            dynamo=True,
            verbose=False,
        )
    net.train(was_training)
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, {ABOUT: json.dumps(about, sort_keys=True)})
    return bytes(model.SerializeToString(deterministic=True))
