"""The figure of an accuracy study: no legend or label covers a marker."""

from __future__ import annotations

from dataclasses import fields

import pytest
from egvs.studies.pareto_figure import draw_figure

from egvs.studies.score_errors import SettingResult
from egvs.studies.study_settings import APPROXIMATES, MEASURES, SCENARIO


def row(setting: str, kind: str, knob: str, seconds: float, judged: float, **more: object) -> SettingResult:
    values = {field.name: 0 for field in fields(SettingResult)} | {"tau": 0.9, "regret": 0.1}
    return SettingResult(
        **{**values, "setting": setting, "kind": kind, "knob": knob, "seconds": seconds, "judged": judged, **more}
    )


def settings(seconds: float, judged: float) -> list[SettingResult]:
    """Settings on a front from 1 s and 10 % to 32 s and 0.3 %, and the scenario's own anywhere."""
    knobs = ("frames", "step", "grid", "period", "azimuth", "channels")
    front = [row(f"{250 << i} frames", APPROXIMATES, knobs[i], 2.0**i, 0.1 / 2**i, front=True) for i in range(6)]
    measures = [row(f"gamma {i}", MEASURES, "gamma", 1.0, 0.5) for i in range(5)]
    return [row(SCENARIO, SCENARIO, "", seconds, judged), *front, *measures]


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "judged"), [(0.8, 0.3), (40.0, 0.3), (40.0, 0.0), (5.0, 0.01)])
def test_legend_and_labels_cover_no_marker(seconds: float, judged: float) -> None:
    figure = draw_figure(settings(seconds, judged), 0.02, "trial")
    panel = figure.axes[0]
    legend = panel.get_legend().get_window_extent(figure.canvas.get_renderer())
    assert not legend.overlaps(panel.bbox)  # where all the markers are
    assert not legend.overlaps(figure.axes[1].get_tightbbox())
    label = panel.xaxis.label.get_window_extent()
    assert not legend.overlaps(label)
    assert legend.x0 >= 0 and legend.y0 >= 0
    star = panel.transData.transform((seconds, 100 * max(judged, 1e-4)))
    assert panel.bbox.contains(*star)
    names = [text.get_window_extent() for text in panel.texts]
    assert len(names) > 3
    assert not any(name.contains(*star) for name in names[1:])
    assert not any(a.overlaps(b) for i, a in enumerate(names) for b in names[i + 1 :])
