# mypy: ignore-errors
"""The march of Amanatides and Woo (1987), with accumulated t, for taichi; imported after ``ti.init``."""

import taichi as ti


@ti.func
def first_plane(o: ti.f64, d: ti.f64, at: ti.i32) -> ti.f64:
    """Share of the segment at which it crosses the first plane along an axis; infinite where it never does."""
    t = ti.f64(ti.math.inf)
    if d > 0:
        t = (at + 1 - o) / d
    if d < 0:
        t = (at - o) / d
    return t


@ti.kernel
def march(
    ends: ti.types.ndarray(dtype=ti.f64, ndim=2),
    ox: ti.f64,
    oy: ti.f64,
    oz: ti.f64,
    nx: ti.i32,
    ny: ti.i32,
    nz: ti.i32,
    hits: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Add 1 for each beam, relative to the sensor o in voxels, to ``hits`` of the voxels that it crosses."""
    for beam in range(ends.shape[0]):
        o = ti.Vector([ox, oy, oz], dt=ti.f64)
        n = ti.Vector([nx, ny, nz], dt=ti.i32)
        d = ti.Vector([ends[beam, 0], ends[beam, 1], ends[beam, 2]], dt=ti.f64)
        t, last = ti.f64(0.0), ti.f64(1.0)
        for a in ti.static(range(3)):
            if d[a] == 0:
                if o[a] < 0 or o[a] >= n[a]:
                    last = -1.0
            else:
                low, high = -o[a] / d[a], (n[a] - o[a]) / d[a]
                t, last = ti.max(t, ti.min(low, high)), ti.min(last, ti.max(low, high))
        if t < last:
            at = ti.Vector([0, 0, 0], dt=ti.i32)
            crossing = ti.Vector([0.0, 0.0, 0.0], dt=ti.f64)
            spacing = ti.Vector([0.0, 0.0, 0.0], dt=ti.f64)
            for a in ti.static(range(3)):
                at[a] = ti.min(ti.max(ti.i32(ti.floor(o[a] + t * d[a])), 0), n[a] - 1)
                crossing[a] = first_plane(o[a], d[a], at[a])
                spacing[a] = ti.abs(1.0 / d[a])
            inside = 1
            while inside == 1:
                hits[(at.x * ny + at.y) * nz + at.z] += 1
                nearest = ti.min(crossing.x, crossing.y, crossing.z)
                if nearest >= last:
                    inside = 0
                else:
                    stepped = 0
                    for a in ti.static(range(3)):
                        if stepped == 0 and crossing[a] == nearest:
                            at[a] += ti.select(d[a] > 0, 1, -1)
                            crossing[a] += spacing[a]
                            stepped = 1
                            if at[a] < 0 or at[a] >= n[a]:
                                inside = 0
