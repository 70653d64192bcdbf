"""The figure of an accuracy study: no legend or label covers a marker, and every setting has one."""

from __future__ import annotations

import pytest

from egvs.results.studies import APPROXIMATES, MEASURES, SCENARIO, SettingResult, Tolerance
from egvs.studies.decision_figure import draw_figure
from tests.studies.test_recommendation import row


def settings(seconds: float, loss_points: float) -> list[SettingResult]:
    """Settings on a front from 1 s and 3 points to 32 s and 0.1, and the scenario's own anywhere."""
    knobs = ("frames", "step", "period", "sampled frames", "sublanes", "effect")
    front = [
        row(f"{250 << i} frames", 2.0**i, 3.0 / 2**i, kind=APPROXIMATES, knob=knobs[i], front=True) for i in range(6)
    ]
    measures = [row(f"gamma {i}", 1.0 + i, 2.5, kind=MEASURES, knob="gamma") for i in range(5)]
    return [row(SCENARIO, seconds, loss_points, kind=SCENARIO, recommended=True), *front, *measures]


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "loss_points"), [(0.8, 3.3), (40.0, 3.0), (40.0, 0.0), (5.0, 0.01)])
def test_legend_and_labels_cover_no_marker(seconds: float, loss_points: float) -> None:
    figure = draw_figure(settings(seconds, loss_points), Tolerance(1.0), "trial")
    (panel,) = figure.axes
    legend = panel.get_legend().get_window_extent(figure.canvas.get_renderer())
    assert not legend.overlaps(panel.bbox)  # where all the markers are
    assert not legend.overlaps(panel.xaxis.label.get_window_extent())
    assert legend.x0 >= 0 and legend.y0 >= 0
    star = panel.transData.transform((seconds, loss_points))
    assert panel.bbox.contains(*star)
    names = [text.get_window_extent() for text in panel.texts]
    assert len(names) > 3
    assert not any(name.contains(*star) for name in names[1:])
    assert not any(a.overlaps(b) for i, a in enumerate(names) for b in names[i + 1 :])


@pytest.mark.slow
def test_tolerance_of_the_score_draws_no_tolerance_of_the_loss() -> None:
    figure = draw_figure(settings(5.0, 0.5), Tolerance(1.0, 0.02), "trial")
    assert not any(text.get_text().startswith("tolerance") for text in figure.axes[0].texts)
