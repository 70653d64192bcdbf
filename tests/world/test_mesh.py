"""The mesh of the static world: statics.ply, and which solids are closed."""

import contextlib
import dataclasses
import re

import numpy as np
import pytest
import trimesh

from egvs.core.errors import InputError
from egvs.world.mesh import World, read_ply, write_ply
from tests.world.static_worlds import (
    BOX,
    COURT,
    HOLE,
    SQUARE,
    build,
    polygon,
)


def test_ply_round_trip_is_exact(tmp_path):
    world, _ = build(tmp_path, polygon(COURT, HOLE), polygon(SQUARE, name='quote " and é'))
    write_ply(tmp_path / "w.ply", world, {"any": 1})
    again, metadata = read_ply(tmp_path / "w.ply")
    assert (again.vertices_m == world.vertices_m).all()
    assert (again.faces == world.faces).all()
    assert (again.solid_of_face == world.solid_of_face).all()
    assert again.solids == world.solids
    assert metadata == {"any": 1}
    assert len(trimesh.load(tmp_path / "w.ply", process=False).faces) == len(world.faces)
    original = (tmp_path / "w.ply").read_bytes()
    for broken in (
        original[:-1],
        original[: len(original) // 2],
        b"",
        original.replace(b"element face", b"element fact", 1),
        b"ply\nend_header\n",
    ):
        (tmp_path / "w.ply").write_bytes(broken)
        with pytest.raises(InputError, match=r"complete statics\.ply"):
            read_ply(tmp_path / "w.ply")


INDICES = {
    "a vertex beyond the last": ("faces", 8, "expected a vertex from 0 to 7, got 8"),
    "a vertex before the first": ("faces", -1, "expected a vertex from 0 to 7, got -1"),
    "a solid beyond the last": ("solid_of_face", 1, "expected a solid from 0 to 0, got 1"),
    "a solid before the first": ("solid_of_face", -2, "expected a solid from 0 to 0, got -2"),
    "a vertex that is no number": ("vertices_m", np.nan, "expected finite coordinates"),
}


@pytest.mark.parametrize(("column", "value", "message"), INDICES.values(), ids=INDICES.keys())
def test_rejects_ply_with_invalid_values(tmp_path, column, value, message):
    world, _ = build(tmp_path, polygon(SQUARE))
    values = getattr(world, column).copy()
    values.flat[5] = value
    write_ply(tmp_path / "w.ply", dataclasses.replace(world, **{column: values}), {})
    with pytest.raises(InputError, match=re.escape(f"w.ply: {message}")):
        read_ply(tmp_path / "w.ply")


def test_ply_with_flipped_bit_is_read_or_rejected(tmp_path):
    world, _ = build(tmp_path, polygon(SQUARE))
    write_ply(tmp_path / "w.ply", world, {"any": 1})
    original = (tmp_path / "w.ply").read_bytes()
    for bit in range(0, 8 * len(original), 17):
        data = bytearray(original)
        data[bit // 8] ^= 1 << bit % 8
        (tmp_path / "w.ply").write_bytes(data)
        with contextlib.suppress(InputError):
            again, _ = read_ply(tmp_path / "w.ply")
            assert np.isfinite(again.triangles_m).all()
            assert len(again.closed) == len(again.solids)


def test_closed_requires_opposite_edges():
    faces = np.array(BOX.faces, dtype=np.int32)
    twice = np.concatenate([faces, faces + 8])
    owner = np.repeat([0, 1], 12).astype(np.int32)
    points = np.concatenate([BOX.vertices, BOX.vertices + 20])
    names = (("a", "x"), ("b", "x"))
    assert World(points, twice, owner, names).closed.tolist() == [True, True]
    assert World(points, twice[:-1], owner[:-1], names).closed.tolist() == [True, False]
    assert World(points, faces, owner[:12], names).closed.tolist() == [True, False]
    doubled = World(points[:8], np.concatenate([faces, faces[:1]]), np.zeros(13, dtype=np.int32), names[:1])
    assert doubled.closed.tolist() == [False]
    far = World(points + np.array([393216.0, 3932160.0, 64.0]), twice[:, ::-1].copy(), owner, names)
    assert far.signs.tolist() == [-1, -1]
