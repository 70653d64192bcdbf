"""Bodies of vehicles: closed, exactly as large as their box, one for every vClass; meshes of users."""

from typing import get_args

import numpy as np
import pytest
import trimesh

from egvs import load
from egvs.clouds import simulation as cloud_simulation
from egvs.core.errors import InputError
from egvs.runs import run
from egvs.scenario.model import BodyKind
from tests.clouds.cloud_scenes import frame_of


@pytest.mark.parametrize("kind", sorted(cloud_simulation.builtin_bodies()))
class TestBuiltinBodies:
    def test_touches_every_face_of_its_box(self, kind):
        corners = np.concatenate([part.triangles for part in cloud_simulation.builtin_bodies()[kind]]).reshape(-1, 3)
        np.testing.assert_array_equal(corners.min(axis=0), [-0.5] * 3)
        np.testing.assert_array_equal(corners.max(axis=0), [0.5] * 3)

    def test_parts_are_closed_convex_and_face_outwards(self, kind):
        for part in cloud_simulation.builtin_bodies()[kind]:
            mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(part.triangles))
            assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
            hull = mesh.convex_hull.volume
            assert mesh.volume == pytest.approx(hull, rel=0.01)  # sides that lean in are warped a little

    def test_is_small_and_connected(self, kind):
        parts = cloud_simulation.builtin_bodies()[kind]
        assert sum(len(part.triangles) for part in parts) <= 300
        low, high = (np.array([getattr(p.triangles, of)(axis=(0, 1)) for p in parts]) for of in ("min", "max"))
        joined = ((low[:, None] < high) & (low < high[:, None])).all(axis=2)
        for _ in parts:
            joined = joined @ joined
        assert joined.all()

    def test_surfaces_have_reflectivity(self, kind):
        assert {part.surface for part in cloud_simulation.builtin_bodies()[kind]} <= set(cloud_simulation.REFLECTIVITY)


def test_scenario_accepts_all_kinds():
    assert set(get_args(BodyKind)) == set(cloud_simulation.builtin_bodies())


@pytest.mark.parametrize(
    ("vclass", "size_m", "part", "jointed", "kind"),
    [
        ("passenger", (4.5, 1.75, 1.5), 0, False, "sedan"),
        ("passenger", (3.4, 1.48, 1.78), 0, False, "kei"),
        ("passenger", (3.4, 1.6, 1.5), 0, False, "sedan"),
        ("passenger", (4.9, 1.9, 2.1), 0, False, "van"),
        ("taxi", (4.4, 1.7, 1.75), 0, False, "taxi"),
        ("delivery", (4.9, 1.9, 2.1), 0, False, "van"),
        ("truck", (7.6, 2.3, 3.0), 0, False, "truck"),
        ("truck", (3.8, 2.5, 3.8), 0, True, "tractor"),
        ("trailer", (12.0, 2.5, 3.8), 1, True, "trailer"),
        ("bus", (10.9, 2.5, 3.1), 0, False, "bus"),
        ("bus", (7.0, 2.5, 3.1), 1, True, "bus"),
        ("pedestrian", (0.8, 0.6, 1.73), 0, False, "pedestrian"),
        ("bicycle", (1.76, 0.6, 1.73), 0, False, "bicycle"),
        ("custom1", (5.9, 2.0, 2.5), 0, False, "van"),
        ("passenger", (12.0, 2.55, 3.1), 0, False, "bus"),
        ("custom1", (16.0, 2.5, 3.8), 0, False, "truck"),
    ],
)
def test_kind_of_body_by_vclass_and_size(vclass, size_m, part, jointed, kind):
    assert cloud_simulation.body_kind(vclass, list(size_m), part, jointed) == kind


def test_every_listed_vclass_has_body():
    for vclass in cloud_simulation._read_bodies_file()["classes"]:
        assert cloud_simulation.body_kind(vclass, [4.5, 1.8, 1.5]) in cloud_simulation.builtin_bodies()


def _scenario(mini, name):
    return load(mini, [f'validation.bodies.truck="{name}"'])


def test_scales_user_mesh_to_unit_box(mini):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.apply_scale([4.0, 1.0, 2.0])
    mesh.apply_translation([100.0, -3.0, 7.0])
    mesh.export(mini / "own.ply")
    corners = np.concatenate(
        [p.triangles for p in cloud_simulation.read_body(mini / "own.ply", "validation.bodies.truck")]
    )
    assert corners.shape == (len(mesh.faces), 3, 3)
    np.testing.assert_array_equal(corners.min(axis=(0, 1)), [-0.5] * 3)
    np.testing.assert_array_equal(corners.max(axis=(0, 1)), [0.5] * 3)
    scenario = _scenario(mini, "own.ply")
    made = cloud_simulation.vehicle_meshes(scenario)
    assert made.kinds == cloud_simulation.vehicle_meshes(load(mini)).kinds
    before = cloud_simulation.hash_body_files(scenario)
    mesh.apply_scale([1.0, 1.0, 1.1])
    mesh.export(mini / "own.ply")
    assert cloud_simulation.hash_body_files(scenario) != before and set(before) == {"bodies.toml", "own.ply"}


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("none.ply", None, r"validation\.bodies\.truck = 'none\.ply': no such file"),
        ("text.ply", lambda p: p.write_text("no mesh"), r"validation\.bodies\.truck: .*text\.ply: cannot be loaded"),
        (
            "points.ply",
            lambda p: trimesh.PointCloud([[0, 0, 0], [1, 1, 1]]).export(p),
            r"points\.ply: the file has no triangles",
        ),
        (
            "flat.ply",
            lambda p: trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(p),
            r"flat\.ply: the mesh has no extent along z",
        ),
        (
            "fine.ply",
            lambda p: trimesh.creation.icosphere(subdivisions=5).export(p),
            r"fine\.ply: expected at most 5,000 triangles, got 20,480",
        ),
        (
            "nan.ply",
            lambda p: trimesh.Trimesh([[0, 0, 0], [1, 0, np.nan], [0, 1, 1]], [[0, 1, 2]], process=False).export(p),
            r"nan\.ply: a triangle has a non-finite vertex",
        ),
    ],
)
def test_rejects_unusable_mesh(mini, name, write, message):
    if write is not None:
        write(mini / name)
    with pytest.raises(InputError, match=message):
        cloud_simulation.vehicle_meshes(_scenario(mini, name))


def test_rejects_unknown_kind(mini):
    with pytest.raises(InputError, match=r"validation\.bodies\.lorry: expected 'sedan', 'kei'"):
        load(mini, ['validation.bodies.lorry="own.ply"'])


def test_articulated_truck_is_tractor_with_trailers_but_not_bus():
    rows = [(0.0, 0.0, 1.5, 5.0, 2.5, 3.0, 0.0, 0.0)] * 5
    frame = frame_of(rows, ["trailer"] * 2 + ["bus"] * 2 + ["truck"], vehicles="aabbc", part=[0, 1, 0, 1, 0])
    made = cloud_simulation.VehicleMeshes.from_parts(cloud_simulation.builtin_bodies())
    assert [made.kinds[k] for k in made.kinds_of_boxes(frame)] == ["tractor", "trailer", "bus", "bus", "truck"]


def test_stages_do_not_depend_on_bodies_and_noise(mini, tmp_path):
    """A body, or the noise of a range, makes no stage run again."""
    given = ["sensors.small.range_sigma_m=0.1", 'validation.bodies.truck="own.ply"']
    first, then = (run.run(load(mini, some), tmp_path / "run").stages for some in ([], given))
    for name in ("traffic", "statics", "tpog", "scan", "score"):
        assert then[name].inputs == first[name].inputs
