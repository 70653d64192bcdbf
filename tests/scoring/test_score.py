"""Does a score depend on what it is defined by and on nothing else: not on threads, nor on the order or company of
sites?"""

import itertools
import json
from fractions import Fraction
from math import inf

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egvs.artefacts.readers import read_scores, read_visibility
from egvs.artefacts.tpog import read_tpog
from egvs.core.errors import InputError
from egvs.scenario import loading
from egvs.scoring.egvs import binary_entropy
from egvs.scoring.scorer import ranks
from egvs.stages import scan, score, statics, tpog, traffic
from tests.stage_runner import run_stage

STAGES = (traffic, statics, tpog, scan, score)


def load(folder, *overrides):
    return loading.load(folder, ["score.keep_visibility=all", *overrides])


def run(folder, out, *overrides, stages=STAGES, jobs=None):
    loaded = load(folder, *overrides)
    for stage in stages:
        run_stage(stage, loaded, out, jobs=jobs)
    return {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}


def true_score(out, site, gamma):
    """The rational sum, rounded once."""
    field, hits = read_tpog(out / "tpog.parquet"), read_visibility(out / "visibility.parquet", site)
    total = Fraction(0)
    for count, hit in zip(field.counts[field.counts > 0].tolist(), hits[field.counts > 0].tolist(), strict=True):
        total += Fraction(binary_entropy(count, field.frames)) * (Fraction(hit) if hit <= gamma else Fraction(gamma))
    return float(total)


def write_sites(folder, *rows):
    (folder / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\n" + "\n".join(rows) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize("gamma", [0.0, 0.3, 1.0, 4.0, 1e9, inf])
def test_score_is_its_definition(mini, tmp_path, gamma):
    rows = run(mini, tmp_path, f"score.gamma={gamma}")
    for site, row in rows.items():
        assert row["egvs"] == true_score(tmp_path, site, gamma)
        assert row["egvs"] <= row["egvs_limit"]
        assert (row["egvs"] > 0) == (gamma > 0)
        assert 0 < row["entropy_seen"] <= 1
    about = json.loads(pq.read_metadata(tmp_path / "scores.parquet").metadata[b"egvs"])
    assert float(about["gamma"]) == gamma


@pytest.mark.slow
def test_number_of_threads_changes_no_byte(mini, tmp_path):
    write_sites(mini, *(f"s{n},{9 + 3 * n},11,{3 + n / 2},small" for n in range(8)))
    run(mini, tmp_path)
    files = ("scans.parquet", "scores.parquet", "visibility.parquet")
    before = [(tmp_path / name).read_bytes() for name in files]
    for jobs in (1, 2, 4):
        run(mini, tmp_path, stages=(scan, score), jobs=jobs)
        assert [(tmp_path / name).read_bytes() for name in files] == before


def test_scanning_on_the_fly_gives_the_same_scores(mini, tmp_path):
    kept = run(mini, tmp_path)
    assert run(mini, tmp_path, "scan.keep=false", stages=(scan, score), jobs=2) == kept
    assert not (tmp_path / "scans.parquet").exists()


@pytest.mark.slow
def test_order_and_company_of_sites_change_no_score(mini, tmp_path):
    rows = ["a,10,12,3,small", "b,30.5,-12,3,small", "c,5,11,6,VLP-16", "d,22,11,2.5,small"]
    found = []
    for number, chosen in enumerate([rows, rows[::-1], rows[1:3]]):
        write_sites(mini, *chosen)
        found.append(run(mini, tmp_path / str(number)))
        assert list(found[-1]) == [row[0] for row in chosen]
    own = ("x_m", "egvs", "egvs_limit", "entropy_seen", "beams", "beams_in_roi", "returns")
    for other, (site, row) in itertools.product(found[1:], found[0].items()):
        if site in other:
            assert [other[site][key] for key in own] == [row[key] for key in own]


def test_equal_sites_share_a_rank(mini, tmp_path):
    write_sites(mini, "a,10,12,3,small", "b,10,12,3,small", "far,10,90,3,small", "c,10,12,3,small")
    rows = run(mini, tmp_path)
    assert len({rows[s]["egvs"] for s in "abc"}) == 1
    assert [rows[s]["rank"] for s in ("a", "b", "c", "far")] == [1, 1, 1, 4]


def test_ranks():
    assert ranks(np.array([2.0, 5.0, 2.0, 0.0, 5.0])).tolist() == [3, 1, 3, 5, 1]
    assert ranks(np.zeros(3)).tolist() == [1, 1, 1]
    assert ranks(np.array([np.nextafter(1.0, 2.0), 1.0])).tolist() == [1, 2]


def test_a_site_that_sees_nothing_scores_zero_and_comes_last(mini, tmp_path):
    text = (mini / "scenario.toml").read_text()
    (mini / "scenario.toml").write_text(
        text + "\n[sensors.up]\nelevations_deg = [80]\nazimuth_step_deg = 10\nrange_m = 100\n"
    )
    write_sites(mini, "blind,10,12,7,up", "sees,10,12,3,small")
    rows = run(mini, tmp_path)
    assert (rows["blind"]["egvs"], rows["blind"]["entropy_seen"], rows["blind"]["rank"]) == (0.0, 0.0, 2)
    assert rows["blind"]["beams_in_roi"] == 0
    assert rows["sees"]["rank"] == 1
    assert rows["sees"]["egvs"] > 0
    assert read_visibility(tmp_path / "visibility.parquet", "blind").sum() == 0


def test_one_frame_has_no_entropy(mini, tmp_path):
    rows = run(mini, tmp_path, "traffic.frames=1", "tpog.blocks=1")
    field = read_tpog(tmp_path / "tpog.parquet")
    assert field.frames == 1
    assert set(np.unique(field.counts).tolist()) == {0, 1}
    for row in rows.values():
        assert (row["egvs"], row["egvs_limit"], row["entropy_seen"], row["rank"]) == (0.0, 0.0, 0.0, 1)


@pytest.mark.parametrize("gamma", [0.0, 10.0, inf])
def test_traffic_elsewhere_has_no_entropy_here(mini, tmp_path, gamma):
    rows = run(mini, tmp_path, "roi.center_m=[20, 100, 2.5]", "sites.sensor=VLP-32C", f"score.gamma={gamma}")
    assert read_tpog(tmp_path / "tpog.parquet").counts.sum() == 0
    for row in rows.values():
        assert (row["egvs"], row["egvs_limit"], row["entropy_seen"], row["rank"]) == (0.0, 0.0, 0.0, 1)


def test_static_voxels_have_no_entropy(mini, tmp_path):
    """A slab over the whole region: every voxel is filled, and the sites stand on top of it."""
    slab = [[[-30, -30], [70, -30], [70, 30], [-30, 30], [-30, -30]]]
    geometry = {"type": "Polygon", "coordinates": slab}
    (mini / "statics.geojson").write_text(
        json.dumps(
            {
                "type": "FeatureCollection",
                "crs": None,
                "features": [{"type": "Feature", "geometry": geometry, "properties": {"height_m": 5}}],
            }
        )
    )
    write_sites(mini, "top,10,12,8,small", "roof,10,12,5,small")
    rows = run(mini, tmp_path)
    assert read_tpog(tmp_path / "tpog.parquet").counts.sum() == 0
    for row in rows.values():
        assert (row["egvs"], row["egvs_limit"], row["entropy_seen"]) == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_gamma_and_voxels_need_no_new_scan(mini, tmp_path):
    run(mini, tmp_path)
    before = (tmp_path / "scans.parquet").read_bytes()
    rows = run(mini, tmp_path, "score.gamma=1", "roi.voxel_m=1", stages=(tpog, score))
    assert all(row["egvs"] == true_score(tmp_path, site, 1.0) for site, row in rows.items())
    run(mini, tmp_path, "roi.voxel_m=1", stages=(scan,))
    assert (tmp_path / "scans.parquet").read_bytes() == before


def rewrite(path, change):
    """Write a Parquet file again with its rows or its metadata changed."""
    table, about = pq.read_table(path), json.loads(pq.read_metadata(path).metadata[b"egvs"])
    table, about = change(table, about)
    pq.write_table(table.replace_schema_metadata({"egvs": json.dumps(about)}), path)


def put(name, row, value):
    def change(table, about):
        column = table[name].to_numpy().copy()
        column[row] = value
        return table.set_column(table.schema.get_field_index(name), table.schema.field(name), pa.array(column)), about

    return change


@pytest.mark.parametrize(
    ("artefact", "change", "message"),
    [
        ("tpog", put("ix", 0, 10**6), "expected ix from 0 to "),
        ("tpog", put("iz", -1, -1), "expected iz from 0 to "),
        ("tpog", put("count", 0, 41), "occupied in 41 of 40 frames"),
        ("tpog", put("count", 0, 2**32 - 1), "of 40 frames"),
        ("tpog", lambda t, a: (t, a | {"schema": 999}), "expected schema version 1, got 999"),
        ("tpog", lambda t, a: (t.drop_columns("count"), a), "the column 'count' is missing"),
        ("scans", put("dx_m", 5, np.nan), "non-finite"),
        ("scans", put("dz_m", 5, np.inf), "non-finite"),
    ],
)
def test_rejects_altered_artefacts(mini, tmp_path, artefact, change, message):
    run(mini, tmp_path)
    rewrite(tmp_path / f"{artefact}.parquet", change)
    if artefact == "scans":  # one row group a site, as the stage writes it
        table, meta = pq.read_table(tmp_path / "scans.parquet"), pq.read_metadata(tmp_path / "scans.parquet").metadata
        with pq.ParquetWriter(tmp_path / "scans.parquet", table.schema) as file:
            for site in ("pole_a", "pole_b"):
                file.write_table(table.filter(pa.compute.equal(table["site"], site)))
            file.add_key_value_metadata({b"egvs": meta[b"egvs"]})
    with pytest.raises(InputError, match=message):
        run_stage(score, load(mini), tmp_path)


@pytest.mark.slow
def test_counts_may_reach_the_number_of_frames(mini, tmp_path):
    run(mini, tmp_path)
    rewrite(
        tmp_path / "tpog.parquet",
        lambda t, a: (
            t.set_column(4, t.schema.field(4), pa.array([2**32 - 1] * len(t), pa.uint32())),
            a | {"frames": 4 * (2**32 - 1), "block_frames": 2**32 - 1},
        ),
    )
    field = read_tpog(tmp_path / "tpog.parquet")
    assert field.counts.max() >= 2**32 - 1
    assert (field.counts % (2**32 - 1) == 0).all()
    run_stage(score, load(mini), tmp_path)
    assert all(
        row["egvs"] == true_score(tmp_path, row["site"], 4.0)
        for row in read_scores(tmp_path / "scores.parquet").to_pylist()
    )
