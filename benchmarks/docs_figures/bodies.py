"""Draw the bodies of vehicles and people at one scale, each in its box, for docs/validation.md."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from egvs.clouds import simulation as cloud_simulation

COLOURS = {
    "paint": (0.36, 0.47, 0.68),
    "glass": (0.62, 0.8, 0.87),
    "tyre": (0.2, 0.2, 0.22),
    "cloth": (0.78, 0.5, 0.36),
}
ROWS = (("pedestrian", "bicycle", "kei", "sedan", "taxi", "van"), ("truck", "bus", "tractor", "trailer"))
LIGHT = np.array([0.3, -0.45, 0.84])
EYE_DEG = -55.0, 20.0  # azimuth and elevation of the viewer
FINEST_M = 0.15  # triangles are subdivided to this size, so that sorting by distance works
GAP_M, ROW_M, LABEL_M = 0.8, 7.0, 4.3


def draw(folder: Path, images: Path) -> None:
    """Draw all bodies; nothing is run in the folder."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.collections import LineCollection, PolyCollection

    figure, axes = plt.subplots(figsize=(13, 6.4), dpi=100)
    for row, kinds in enumerate(ROWS):
        at = np.array([0.0, -ROW_M * row])
        for kind in kinds:
            size = np.array(tomllib.loads(cloud_simulation.BODIES_FILE.read_text())[kind]["size_m"])
            edges, _ = _project(_edges(size))
            left, right = edges[:, :, 0].min(), edges[:, :, 0].max()
            spare = max(LABEL_M - (right - left), 0.0) / 2
            at[0] += spare - left
            shapes, colours = _paint(kind, size)
            axes.add_collection(PolyCollection(shapes + at, facecolors=colours, edgecolors=colours, linewidths=0.4))
            axes.add_collection(LineCollection(edges + at, colors=(0.55, 0.55, 0.55), linewidths=0.6))
            count = sum(len(part.triangles) for part in cloud_simulation.builtin_bodies()[kind])
            what = " x ".join(f"{value:g}" for value in size)
            text = f"{kind}\n{what} m\n{count} triangles"
            middle, below = at[0] + (left + right) / 2, at[1] + edges[:, :, 1].min() - 0.2
            axes.text(middle, below, text, ha="center", va="top", fontsize=8)
            at[0] += right + spare + GAP_M
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.02)
    axes.set_ylim(-ROW_M * (len(ROWS) - 1) - 5.0, 2.8)
    axes.axis("off")
    figure.savefig(images / "bodies.png", metadata={"Software": None}, bbox_inches="tight")
    plt.close(figure)


def _project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (..., 3) in the picture plane (..., 2), and their distance towards the viewer (...)."""
    azimuth, elevation = np.radians(EYE_DEG)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    eye = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return np.stack([points @ right, points @ np.cross(eye, right)], axis=-1), points @ eye


def _paint(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the visible triangles of a body, subdivided, farthest first; and their colours."""
    import trimesh

    pieces, colours = [], []
    for part in cloud_simulation.builtin_bodies()[kind]:
        corners = (part.triangles * size).reshape(-1, 3)
        vertices, faces = trimesh.remesh.subdivide_to_size(
            corners, np.arange(len(corners)).reshape(-1, 3), FINEST_M, 20
        )
        triangles = vertices[faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        front = _project(normals)[1] > 0
        shade = 0.6 + 0.4 * np.clip(normals[front] @ LIGHT, 0.0, 1.0)
        pieces.append(triangles[front])
        colours.append(np.outer(shade, COLOURS[part.surface]))
    triangles = np.concatenate(pieces)
    flat, near = _project(triangles)
    order = np.argsort(near.mean(axis=1))
    return flat[order], np.concatenate(colours)[order]


def _edges(size: np.ndarray) -> np.ndarray:
    """The twelve edges of a box, (12, 2, 3)."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size / 2
    return np.array([(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if (a != b).sum() == 1])
