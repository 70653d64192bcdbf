"""Impossible requests are rejected before any traffic is simulated, and nothing is written."""

import sys

import pytest

from egvs import load
from egvs.core import plugins
from egvs.core.errors import InputError, MissingExtraError
from egvs.extensions.validation import held_out_traffic, training, validation_run
from egvs.extensions.validation.detectors import base


@pytest.fixture
def nothing_starts(monkeypatch):
    """Whatever would check, simulate or train ends the test."""

    def started(*arguments, **_):
        raise AssertionError(f"work was started: {arguments}")

    for module, name in (
        (validation_run, "_check_scenario"),
        (held_out_traffic, "prepare_held_out_traffic"),
        (held_out_traffic, "ensure_stages"),
    ):
        monkeypatch.setattr(module, name, started)


@pytest.mark.parametrize(
    ("detector", "library", "library_name"),
    [("cluster", "sklearn", "scikit-learn"), ("pointpillars", "onnxruntime", "onnxruntime")],
)
def test_reports_missing_library_of_detector(
    run_egvs, mini, tmp_path, monkeypatch, nothing_starts, detector, library, library_name
):
    monkeypatch.setitem(sys.modules, library, None)
    arguments = ("--frames", "10", "--detector", f"points,{detector}", "--out", tmp_path / "out")
    code, out, error = run_egvs("validate", mini, *arguments)
    hint = "pip install 'egvs[validate]'"
    assert error == f"egvs: the detector {detector} needs {library_name}, which is not installed. Run {hint}\n"
    assert code == 2 and out == "" and not (tmp_path / "out").exists()


def test_every_builtin_detector_names_its_library(monkeypatch):
    builtin = {
        name
        for name in base.detector_names()
        if plugins.plugin_package(base.DETECTORS_GROUP, name) == plugins.PACKAGE_NAME
    }
    for library in ("sklearn", "onnxruntime"):
        monkeypatch.setitem(sys.modules, library, None)
    assert base.make_detector("range_image") is not None  # it needs no library of its own
    for name in builtin - {"range_image"}:
        with pytest.raises(MissingExtraError, match=rf"^the detector {name} needs "):
            base.make_detector(name)


def test_reports_missing_libraries_of_training(run_egvs, mini, tmp_path, monkeypatch, nothing_starts):
    for library in ("torch", "onnxscript"):
        monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.setattr(plugins, "find_spec", lambda name: sys.modules.get(name, "there"))
    code, _, error = run_egvs("train", mini, "--out", tmp_path / "new" / "model.onnx")
    hint = "pip install 'egvs[train]'"
    assert error == f"egvs: training needs PyTorch, onnxscript, which are not installed. Run {hint}\n"
    assert code == 2 and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("model.pt", "--out: expected a file that ends in .onnx, got '{}'"),
        ("model", "--out: expected a file that ends in .onnx, got '{}'"),
        ("folder.onnx", "{}: expected a file, got a folder"),
        ("file/model.onnx", "{}: cannot be written ("),
    ],
)
def test_rejects_model_file_that_cannot_be_written(run_egvs, mini, tmp_path, monkeypatch, nothing_starts, out, message):
    class Learner:
        """In place of PyTorch's, which need not be installed here."""

        class Recipe:
            def __init__(self, **_):
                pass

        @staticmethod
        def train(*_, **__):
            raise AssertionError("training was started")

    monkeypatch.setattr(plugins, "require_libraries", lambda *_: None)
    monkeypatch.setattr(training, "train", Learner, raising=False)
    (tmp_path / "folder.onnx").mkdir()
    (tmp_path / "file").write_text("")
    before = sorted(tmp_path.rglob("*"))
    code, _, error = run_egvs("train", mini, "--out", tmp_path / out)
    assert code == 2 and error.startswith("egvs: " + message.format(tmp_path / out)), error
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("frames", "problem"), [(10_000_001, "10,000,001"), (5_000_000, "10,000,300")])
def test_rejects_too_many_frames(mini, frames, problem):
    text = (mini / "scenario.toml").read_text().replace('fcd = "fcd.csv"', 'network = "net.net.xml"')
    (mini / "net.net.xml").write_text("<net/>")
    (mini / "scenario.toml").write_text(text.replace("warmup_s = 0", "warmup_s = 300"))
    scenario = load(mini)
    with pytest.raises(
        InputError,
        match=rf"^--frames: {frames} frames at least 2 s apart are too many: expected at most .*, got {problem}",
    ):
        held_out_traffic.held_out_scenario(scenario, frames, 2.0)
