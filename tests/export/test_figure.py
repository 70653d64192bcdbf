"""Figures say what the artefacts say, at the size that was asked for, in files that need nothing beside them."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from PIL import Image

from egvs.artefacts.readers import read_scores
from egvs.core import plugins
from egvs.drawing.svg_figures import Bar, FigureStyle, bar_chart
from egvs.export import figure
from egvs.export.figure import FIGURES, draw_figure

Call = Callable[..., tuple[int, str, str]]
SVG = "{http://www.w3.org/2000/svg}"


def drawn(run: Path, what: str, out: Path, **options: object) -> ET.Element:
    return ET.parse(draw_figure(run, what, kind="svg", out=out / f"{what}.svg", **options)).getroot()


@pytest.mark.parametrize("what", FIGURES)
def test_figure_has_the_requested_width_and_needs_no_style_sheet(local: Path, tmp_path: Path, what: str) -> None:
    root = drawn(local, what, tmp_path, width_mm=120.0)
    assert root.get("width") == "120mm"
    _, _, wide, tall = map(float, root.get("viewBox").split())
    assert float(root.get("height").removesuffix("mm")) == pytest.approx(120 * tall / wide, abs=0.01)
    assert 12 / wide * 120 / 25.4 * 72 == pytest.approx(7.0, rel=0.01)  # letters of 7 pt
    text = ET.tostring(root, encoding="unicode")
    assert "var(" not in text
    assert "<style" not in text
    assert "currentColor" not in text
    assert "night" not in text
    assert not re.search(r'(?:href|src)="(?!data:)', text)


def test_bars_are_proportional_to_the_scores(local: Path, tmp_path: Path) -> None:
    root = drawn(local, "ranking", tmp_path)
    bars = [
        float(group.find(f"{SVG}rect").get("width")) for group in root.iter(f"{SVG}g") if group.get("class") == "bar"
    ]
    scores = sorted((row["egvs"] for row in read_scores(local / "scores.parquet").to_pylist()), reverse=True)
    assert bars[1] / bars[0] == pytest.approx(scores[1] / scores[0], abs=0.002)
    titles = [title.text for title in root.iter(f"{SVG}title")]
    assert [title.split(":")[0] for title in titles] == ["pole_b", "pole_a"] or scores[0] == scores[1]


def test_ranking_says_how_many_sites_it_leaves_out(
    local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    note = "best 1 of 2 sites"
    complete = drawn(local, "ranking", tmp_path)
    monkeypatch.setattr(figure, "MAX_BARS", 1)
    shortened = drawn(local, "ranking", tmp_path)
    texts = [[text.text for text in root.iter(f"{SVG}text")] for root in (complete, shortened)]
    assert (note in texts[0], note in texts[1]) == (False, True)
    last_y = max(float(text.get("y")) for text in shortened.iter(f"{SVG}text"))
    assert last_y + 4 <= float(shortened.get("viewBox").split()[3])  # letters that go below the line


def test_letters_are_on_top_of_their_halo() -> None:
    text = FigureStyle.for_print(50.0).text_with_halo("label", 'x="1" y="2"', "a & b")
    halo, letters = ET.fromstring(f"<svg>{text}</svg>").findall("text")
    assert (halo.get("stroke"), halo.get("stroke-width")) == ("#ffffff", "3.5")
    assert (letters.get("stroke"), letters.get("x"), letters.text) == (None, "1", "a & b")


def test_ring_of_the_best_site_is_thicker(local: Path, tmp_path: Path) -> None:
    root = drawn(local, "map", tmp_path)
    assert root.get("fill") == "#1d2430"  # of all text without another colour
    widths = {group.get("class"): group.get("stroke-width") for group in root.iter(f"{SVG}g")}
    assert (widths["site first"], widths["site"]) == ("2.6", "1.2")
    (circle, *_) = (group.find(f"{SVG}circle") for group in root.iter(f"{SVG}g") if group.get("class") == "site first")
    assert (circle.get("class"), circle.get("fill")) == ("q16", "#440154")


def test_error_bar_is_one_standard_error_to_either_side() -> None:
    text = bar_chart([Bar("a", 0.5, 0.1, ""), Bar("b", 0.4, None, "")], "share", "", 100.0, FigureStyle(316.0))
    # 22.8 left, 16 right: 277.2 units for 0.6
    assert 'd="M207.6 17.0H300.0' in text
    assert text.count('class="lead"') == 1


@pytest.mark.slow
@pytest.mark.system  # loading cairo asks the system where it is
def test_pdf_contains_fonts(local: Path, tmp_path: Path) -> None:
    pytest.importorskip("cairosvg", reason="the extra egvs[figure] is not installed")
    made = [draw_figure(local, "seen", site="pole_a", out=tmp_path / name) for name in ("a.pdf", "b.pdf")]
    content = made[0].read_bytes()
    assert content == made[1].read_bytes()
    packed = re.findall(rb"stream\r?\n(.*?)endstream", content, flags=re.DOTALL)
    parts = [zlib.decompressobj().decompress(part) for part in packed if part[:1] == b"\x78"]
    content_unpacked = b"".join([content, *parts])
    described = content_unpacked.count(b"/Type /FontDescriptor")
    assert described > 0
    assert len(re.findall(rb"/FontFile[23]? ", content_unpacked)) == described
    wide, tall = map(float, re.search(rb"/MediaBox \[ 0 0 ([0-9.]+) ([0-9.]+)", content_unpacked).groups())
    assert wide == pytest.approx(85 / 25.4 * 72, abs=0.5)
    assert 0.3 < tall / wide < 2


@pytest.mark.slow
@pytest.mark.system
def test_png_has_a_size_on_paper(local: Path, tmp_path: Path) -> None:
    pytest.importorskip("cairosvg", reason="the extra egvs[figure] is not installed")
    with Image.open(draw_figure(local, "map", kind="png", width_mm=60.0, out=tmp_path / "map.png")) as image:
        assert image.info["dpi"] == pytest.approx((600, 600), abs=0.1)
        assert image.width / 600 * 25.4 == pytest.approx(60.0, abs=0.1)
        assert image.convert("RGB").getpixel((2, 2)) == (255, 255, 255)
        assert len(image.convert("RGB").getcolors(image.width * image.height)) > 50


def test_writes_into_the_run_folder_by_default(local: Path, run_egvs: Call) -> None:
    code, out, err = run_egvs("figure", local, "--what", "seen", "--site", "pole_b", "--format", "svg")
    path = local / "export" / "seen_pole_b.svg"
    assert (code, out, err) == (0, f"{path}\n", "")
    path.unlink()
    path.parent.rmdir()


def test_svg_needs_no_extra_but_pdf_does(
    local: Path, tmp_path: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda name: None)
    code, _, err = run_egvs("figure", local, "--what", "ranking", "--out", tmp_path / "a.pdf")
    needs = "egvs: a pdf figure needs cairosvg, which is not installed. Run pip install 'egvs[figure]'\n"
    assert (code, err) == (2, needs)
    assert run_egvs("figure", local, "--what", "ranking", "--format", "svg", "--out", tmp_path / "a.svg")[0] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--what", "ruins"), "--what: expected one of ranking, map, tpog, seen, missed, got 'ruins'"),
        (("--what", "map", "--format", "gif"), "--format: expected one of pdf, png, svg, got 'gif'"),
        (("--what", "map", "--size", "3mm"), "--size: expected a width of 50 to 1000 mm, got '3mm'"),
        (("--what", "map", "--size", "wide"), "--size: expected a width of 50 to 1000 mm, got 'wide'"),
        (("--what", "map", "--site", "pole_a"), "--site: cannot be combined with --what map"),
        (("--what", "seen", "--site", "x"), "--site: this run has no site 'x'. Choose one of pole_"),
        (("--what", "map", "--out", "a.png"), "--out: expected a name ending in .pdf, got 'a.png'"),
    ],
)
def test_rejects_impossible_requests_with_one_message(
    local: Path, run_egvs: Call, options: tuple[str, ...], message: str
) -> None:
    before = sorted(local.rglob("*"))
    code, out, err = run_egvs("figure", local, *options)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert sorted(local.rglob("*")) == before
