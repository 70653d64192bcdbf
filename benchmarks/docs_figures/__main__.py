"""Remake the pictures of README and docs, and the printed output that pages quote: ``make docs-figures``.

    python -m benchmarks.docs_figures [--only NAME ...] [--work DIR]

Names are those of :data:`SESSIONS` (commands whose output pages quote) and :data:`GROUPS` (pictures). A picture of a
session's run is drawn from that run. ``docs/printed/scores.json`` has the scores that it was drawn from; a test
fails when they are no longer those that the program computes. Pictures of long studies, and of recordings that are not
shipped, are in :data:`STORED` with the command that draws them. At the end, parts of pages that are no longer printed
are listed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks import straight_road
from benchmarks.docs_figures import bodies, desk, effects, explorer, junctions
from benchmarks.docs_figures.printed import DOCS, PRINTED, ROOT, SCORES, Session, pages, quotes_of
from benchmarks.docs_figures.sessions import SESSIONS, session_of
from egvs.core.errors import EgvsError

IMAGES = DOCS / "images"


@dataclass(frozen=True)
class Group:
    """Pictures that are drawn together.

    Attributes
    ----------
    name
        For ``--only``.
    files
        Their paths in ``docs/images``.
    draw
        Draws them from a folder into ``docs/images``.
    session
        The session whose folder is needed; the folder is a new one if None.
    """

    name: str
    files: tuple[str, ...]
    draw: Callable[[Path, Path], None]
    session: str | None = None


def _draw_explorer(folder: Path, images: Path) -> None:
    scratch = folder / "explorer"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    explorer.draw(folder / "runs" / "nishishinjuku", scratch, images)


def _draw_desk(folder: Path, images: Path) -> None:
    served = folder / "served"
    shutil.rmtree(served, ignore_errors=True)
    served.mkdir()
    desk.draw(served, images)


def _draw_straight_road(_: Path, images: Path) -> None:
    straight_road.draw_figure(images / "straight-road.png", straight_road.rows())


GROUPS = (
    Group("bodies", ("bodies.png",), bodies.draw),
    Group("plan", junctions.PLAN_FILES, junctions.draw_plan, "nishishinjuku"),
    Group("junction", junctions.STORY_FILES, junctions.draw_story, "story"),
    Group("explorer", explorer.FILES, _draw_explorer, "nishishinjuku"),
    Group("desk", desk.FILES, _draw_desk),
    Group("seeds", ("seeds.png",), junctions.draw_seeds),
    Group("effects", effects.FILES, effects.draw),
    Group("straight-road", ("straight-road.png",), _draw_straight_road),
)

STORED = {
    "accuracy.png": "egvs accuracy scenarios/nishishinjuku",
    "scaling.png": "make scaling",
    "detectability.png": "python -m benchmarks.across_junctions fit --write FILE --figure FILE",
    "sensor-fit-angles.png": "egvs sensor fit",
    "sensor-fit-ground.png": "egvs sensor fit",
    "sensor-fit-empty-scan.png": "egvs sensor fit",
    "sensor-fit-map.png": "egvs sensor fit --scenario",
}
"""Pictures that stay as they are -> the command that draws them."""

PICTURES = {file: f"make docs-figures, {group.name}" for group in GROUPS for file in group.files} | STORED


def main() -> int:
    """Run sessions and draw pictures, all or some."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.docs_figures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = [session.name for session in SESSIONS] + [group.name for group in GROUPS]
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names))
    parser.add_argument(
        "--work", type=Path, default=ROOT / "build" / "docs-figures", metavar="DIR", help="for the runs"
    )
    options = parser.parse_args()
    work = options.work.resolve()
    try:
        for session in SESSIONS:
            if session.name in options.only:
                _print(session, work / session.name)
        for group in GROUPS:
            if group.name in options.only:
                print(f"{group.name}: {', '.join(group.files)}", flush=True)
                group.draw(_folder(group, work), IMAGES)
                if group.session is not None:
                    _store("pictures", group.name, _read_scores()["sessions"][group.session])
    except EgvsError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print("\n".join(stale_quotes()))
    return 0


def _print(session: Session, folder: Path) -> None:
    """Run the commands of a session and store what they print."""
    print(f"{session.name}: {len(session.commands)} commands", flush=True)
    PRINTED.mkdir(parents=True, exist_ok=True)
    session.file.write_text(session.printed(folder), encoding="utf-8")
    _store("sessions", session.name, session.scores(folder))


def _store(part: str, name: str, scores: dict[str, float]) -> None:
    """Replace the scores of a session or a group of pictures."""
    stored = _read_scores()
    stored[part][name] = scores
    SCORES.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _read_scores() -> dict[str, dict[str, dict[str, float]]]:
    empty: dict[str, dict[str, dict[str, float]]] = {"pictures": {}, "sessions": {}}
    return json.loads(SCORES.read_text(encoding="utf-8")) if SCORES.exists() else empty


def _folder(group: Group, work: Path) -> Path:
    """Return the folder of a group's session, which is run unless it was; or a folder of its own."""
    folder = work / (group.session or group.name)
    if group.session is None:
        folder.mkdir(parents=True, exist_ok=True)
    elif not folder.is_dir():
        _print(session_of(group.session), folder)
    return folder


def stale_quotes() -> list[str]:
    """Return a line for each part of a page that is not what is printed."""
    return [
        f"{quote.page.relative_to(ROOT)}:{quote.line}: not printed: {part}"
        for page in pages()
        for quote in quotes_of(page)
        for part in quote.stale_parts("\n".join(session_of(name).stored for name in quote.sessions))
    ]


if __name__ == "__main__":
    sys.exit(main())
