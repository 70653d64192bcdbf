"""The section of a validation: its sentences on cases small enough for paper, and when it is shown."""

import base64
import html
from types import SimpleNamespace

import pytest

from egvs.artefacts import parquet
from egvs.report.sections import DetectorSummary, SiteDetection

NAN = float("nan")
SCORED = [
    SimpleNamespace(site=name, egvs=run_egvs) for name, run_egvs in zip("abcd", (9.0, 7.0, 5.0, 2.0), strict=True)
]


def _summary(values, tau):
    known = [value for value in values if value is not None]
    ranks = [None if value is None else 1 + sum(other > value for other in known) for value in values]
    sites = {s.site: SiteDetection(v, 0.01, r) for s, v, r in zip(SCORED, values, ranks, strict=True)}
    return DetectorSummary("d", "what", tau, sites)


@pytest.mark.parametrize(
    ("values", "tau", "agreement", "judgement"),
    [
        (  # five of six pairs go the same way
            (0.9, 0.5, 0.6, 0.1), (0.67, 0.2, 1.0),
            "Of 4 sites, the order by EGVS and the order by detection agree in 83% of pairs (Kendall's tau 0.67, "
            "between 0.20 and 1.00 with 95 % confidence).",
            "That is more than chance: a site with a higher score tends to detect more. The best by score, a, has rank "
            "1 by detection.",
        ),
        (  # equal values are no pair that goes one way
            (0.5, 0.5, 0.6, 0.1), (0.18, -0.5, 0.8),
            "Of 4 sites, the order by EGVS and the order by detection agree in 60% of pairs (Kendall's tau 0.18, "
            "between -0.50 and 0.80 with 95 % confidence).",
            "4 sites do not tell: the interval holds 0, and chance alone may order sites like this. The best by score, "
            "a, has rank 2 by detection.",
        ),
        (
            (0.1, 0.2, 0.3, 0.4), (-1.0, -1.0, -0.4),
            "Of 4 sites, the order by EGVS and the order by detection agree in 0% of pairs (Kendall's tau -1.00, "
            "between -1.00 and -0.40 with 95 % confidence).",
            "The score orders these sites the wrong way round: one with a higher score tends to detect less. The best "
            "by score, a, has rank 4 by detection.",
        ),
        (
            (None, 0.3, 0.2, 0.1), (1.0, NAN, NAN),
            "Of 3 sites, the order by EGVS and the order by detection agree in 100% of pairs (Kendall's tau 1.00).",
            "How sure that is cannot be told from 3 sites.",
        ),
        (
            (None, None, None, 0.1), (NAN, NAN, NAN),
            "1 site with values: too few, or too much alike, to compare two orders.", "",
        ),
    ],
)  # fmt: skip
def test_orders_are_compared_in_words(values, tau, agreement, judgement):
    summary = _summary(values, tau)
    assert summary.agreement(SCORED) == agreement
    assert summary.judgement(SCORED) == judgement


@pytest.mark.slow
def test_a_validation_is_shown_beside_its_own_run_alone(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    validate = ("validate", mini, "--out", out, "--frames", "10", "--detector", "points", "--jobs", "1")

    def section():
        text = (out / "report.html").read_text()
        return text[text.index('<section id="detected">') :].split("</section>")[0] if 'id="detected"' in text else ""

    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert not section()
    code, printed, error = run_egvs(*validate)
    assert code == 0, error
    shown = html.unescape(section())
    assert f"data:image/png;base64,{base64.b64encode((out / 'validation.png').read_bytes()).decode()}" in shown
    assert "in 10 frames of traffic, at least 2 s apart, with 18 vehicles in the region" in shown
    assert "to compare two orders" in shown  # of two sites
    assert "evaluated with the frames that the TPOG was computed from" in shown and str(mini) not in shown
    for row in parquet.read_artefact(out / "detection.parquet", "detection")[0].to_pylist():
        if row["objects_of"] == "vehicles":
            assert f"{100 * row['seen_20']:.1f} ± {100 * row['seen_20_se']:.1f}" in shown
    assert str(out / "report.html") in printed
    assert run_egvs("verify", out)[0] == 0

    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not section()  # the scores that were validated are others
    assert run_egvs(*validate, "--set", "score.gamma=3.0")[0] == 0
    assert section()
    (out / "detection.parquet").unlink()
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not section()


@pytest.mark.slow
def test_a_damaged_validation_is_named(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("validate", mini, "--out", out, "--frames", "10", "--detector", "points", "--jobs", "1")[0] == 0
    (out / "correlation.parquet").write_bytes(b"PAR1")
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "correlation.parquet: does not match its checksum in validation.sha256. Remove it, or" in error
    (out / "validation.sha256").unlink()  # as an earlier version left none
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "correlation.parquet: is not a validation (" in error
    assert "Remove it, or run egvs validate again." in error
