"""What a case is: a scenario that is right, and one mistake; and ways to plant mistakes.

A case names the file or key and words of the mistake that the program must name. It is made of functions that write the
scenario (:mod:`tests.planted.scenes`) and of one that plants the mistake in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.planted import scenes
from tests.planted.scenes import Scene, street
from tests.planted.truth import (
    STREET,
    Mount,
    Truth,
)

Make = Callable[[], Scene]
Plant = Callable[[Scene], None]


@dataclass(frozen=True)
class Case:
    """A scenario and a mistake.

    Attributes
    ----------
    name
        What is wrong.
    make
        Returns the right scenario.
    plant
        Makes the mistake.
    where, text
        Parts of the message: the file or key, and the mistake.
    is_error
        Whether the mistake stops a run; else it is a warning.
    expected
        Rules of warnings that the right scenario has.
    tolerance
        Relative, of the right scores: what rounding in files changes.
    scores
        Right scores, if they are not those of the truth.
    extension
        Name of the extension that reads the files.
    starts_processes
        Whether another program has to run.
    """

    name: str
    make: Make
    plant: Plant
    where: str
    text: str
    is_error: bool = True
    expected: frozenset[str] = frozenset()
    tolerance: float = 1e-9
    scores: Callable[[], dict[str, float]] | None = None
    extension: str = ""
    starts_processes: bool = False


def key(name: str, value: Any) -> Plant:
    """Give a key of scenario.toml a value; None removes it."""

    def plant(scene: Scene) -> None:
        if value is None:
            del scene.config[name]
        else:
            scene.config[name] = value

    return plant


def text(name: str, old: str, new: str) -> Plant:
    """Replace a text in a file."""
    return lambda scene: scene.replace(name, old, new)


def file(name: str, content: Callable[[Scene], str | bytes]) -> Plant:
    """Write a file again."""

    def plant(scene: Scene) -> None:
        assert name in scene.files
        changed = content(scene)
        assert changed != scene.files[name]
        scene.files[name] = changed

    return plant


def fcd(**changes: Any) -> Plant:
    """Change columns of the finished FCD file, row by row."""
    return file("fcd.csv", lambda scene: scenes.fcd_csv(scene.truth.frames, **changes))


def track(**changes: Callable[[dict[str, Any]], Any]) -> Plant:
    """Change columns of the tracks, row by row."""

    def content(scene: Scene) -> str:
        rows = scenes.track_rows(scene.truth.frames)
        return scenes.csv_text([{k: changes[k](row) if k in changes else v for k, v in row.items()} for row in rows])

    return file("tracks.csv", content)


def mounts(change: Callable[[Mount], Mount]) -> Plant:
    """Change each row of the sites file."""
    return file("sites.csv", lambda scene: scenes.sites([(name, change(m)) for name, m in scene.truth.mounts]))


def site_names(**names: str) -> Plant:
    """Rename columns of the sites file."""
    return file("sites.csv", lambda scene: scenes.sites(scene.truth.mounts, names=names))


def make(*steps: Plant, truth: Truth = STREET) -> Make:
    """The street, with changes that are no mistake."""

    def write() -> Scene:
        scene = street(truth)
        for step in steps:
            step(scene)
        return scene

    return write


def add(name: str, content: str | bytes | Callable[[], str]) -> Plant:
    """Add a file."""

    def step(scene: Scene) -> None:
        assert name not in scene.files
        scene.files[name] = content() if callable(content) else content

    return step


def both(*steps: Plant) -> Plant:
    """Do several steps."""

    def plant(scene: Scene) -> None:
        for step in steps:
            step(scene)

    return plant
