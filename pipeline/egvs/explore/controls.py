"""The panel and its markdown.

What the page says of a sensor in words: markdown.

The panel beside the scene: what is chosen there, typed and ticked, and what it says.

A control says only what somebody wants (``ask``, with the fields of :class:`egvs.explore.view_state.View` that change);
what is shown comes back through :meth:`Controls.show`. So all browsers show the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Protocol, get_args

import viser

from egvs.explore.session import MovingPlan, PoseScore, Session
from egvs.explore.settings import Settings
from egvs.explore.view_state import LAYERS, View
from egvs.scenario.score_config import OtherScore
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose, Site

MAX_LISTED = 20
"""Rows of the ranked list; the others are in the list to choose from."""

WORKING_TITLE = "## working ..."
"""While a run with other settings is made."""

_SHARE_SCORES = ("entropy_seen", "coverage", "expected_visibility", "expected_detections", "seen_well")
_MARKDOWN_ESCAPES = str.maketrans({sign: f"\\{sign}" for sign in "\\`*_{}[]()<>#+-.!|"})


def describe_score(rating: PoseScore, rank_by: str, candidate: PoseScore, candidates: int) -> str:
    """What a sensor is worth where it is, beside its candidate; or why none can stand there."""
    told = "\n".join(
        f"- {'**cannot stand:**' if finding.is_error else '**warning:**'} {escape_markdown(str(finding))}"
        for finding in rating.findings
    )
    if not rating.is_feasible:
        return f"## no score\n\n{told}"
    score, before = rating.scores[rank_by], candidate.scores[rank_by]
    more = f" ({score / before - 1.0:+.1%})" if before > 0.0 and rating.site.pose != candidate.site.pose else ""
    rows = "\n".join(
        f"| {escape_markdown(name)} | {format_score(name, value)} |" for name, value in rating.scores.items()
    )
    head = (
        f"## {format_score(rank_by, score)}{more}\n\nrank {rating.rank} of {candidates} by {escape_markdown(rank_by)}"
    )
    return f"{head}\n\n| score | value |\n|---|---|\n{rows}\n\n{told}"


def format_notice(text: str) -> str:
    """What went wrong."""
    return f"**{escape_markdown(text)}**\n\n"


def describe_drawn_triangles(triangles: int, of: int) -> str:
    """Whether the static world is drawn coarser than it is; nothing where it is not."""
    return f"{triangles:,} of {of:,} triangles are drawn; beams meet all of them." if triangles < of else ""


def describe_plan(moving_plan: MovingPlan) -> str:
    """What the sensors of a plan are worth together as they are now, and where one more would be best."""
    names, value = (
        ", ".join(map(escape_markdown, moving_plan.sites)),
        format_score(moving_plan.poses.placement_problem.score, moving_plan.joint),
    )
    more = ""
    if moving_plan.best_next is not None:
        name, gain = moving_plan.best_next
        more = f"; best for one more: {escape_markdown(name)} (+{gain:,.4g})"
    return f"\n\n**plan** {names}: together {value}{more}"


def ranking_table(ranked: Sequence[PoseScore], rank_by: str) -> str:
    """The best candidates as a table."""
    rows = "\n".join(
        f"| {its.rank} | {escape_markdown(its.site.name)} | {format_score(rank_by, its.scores[rank_by])} |"
        for its in ranked[:MAX_LISTED]
    )
    rest = f"\n\n... and {len(ranked) - MAX_LISTED} more" if len(ranked) > MAX_LISTED else ""
    return f"| rank | site | {escape_markdown(rank_by)} |\n|---|---|---|\n{rows}{rest}"


def candidate_label(rating: PoseScore, rank_by: str) -> str:
    """A candidate in the list to choose from."""
    return f"{rating.rank}. {rating.site.name}: {format_score(rank_by, rating.scores[rank_by])}"


def format_score(name: str, value: float) -> str:
    """A score with as many digits as a planner reads."""
    return f"{value:.2%}" if name in _SHARE_SCORES else f"{value:,.1f}" if abs(value) >= 100.0 else f"{value:.4g}"


def escape_markdown(text: str) -> str:
    """A text that markdown shows as it is."""
    return text.translate(_MARKDOWN_ESCAPES).replace("\n", " ")


_POSE_LABELS = {
    "x_m": "x m",
    "y_m": "y m",
    "z_m": "z m",
    "yaw_deg": "yaw deg",
    "pitch_deg": "tilt deg",
    "roll_deg": "roll deg",
}
_LENGTH_STEP, _ANGLE_STEP = 0.001, 0.01
_ALL_PERIODS, _BEST_OTHER = "all periods", "the best other one"
_LAYER_NAMES = {words: name for name, words in LAYERS.items()}
_FIRST_SCORES = ("egvs", "points_on_target", "expected_detections")


class PageActions(Protocol):
    """The page, as its controls know it."""

    def ask(self, **changes: Any) -> None:
        """Show something else."""

    def present(self, candidate: Site) -> Site:
        """Where a candidate's sensor is now."""


class Controls:
    """The panel.

    Parameters
    ----------
    gui
        Of the page.
    session, view
        As the page is opened.
    effects
        Those that may be switched, by name, and why.
    frames
        That were recorded.
    buttons
        What is done by whom presses them, by what stands on them.
    note
        What is to be known of the picture, markdown; nothing where it is empty.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        session: Session,
        view: View,
        page: PageActions,
        effects: dict[str, str],
        frames: int,
        buttons: Mapping[str, Callable[[viser.ClientHandle], None]],
        note: str,
    ) -> None:
        self._gui, self._session, self._view, self._page = gui, session, view, page
        self._theme(False)
        gui.main_panel.dock_right()
        self._sites: dict[str, Site] = {}
        self._site = gui.add_dropdown("site", ("",), hint="Candidates, the best first.")
        self._site.on_update(self._chosen)
        self.status = gui.add_markdown("")
        with gui.add_folder("layer"):
            self._draw_layer(session, frames)
            if note:
                gui.add_markdown(note)
        with gui.add_folder("pose"):
            self._draw_pose(session)
        with gui.add_folder("scored by", expand_by_default=False):
            self._draw_settings(session, effects)
        for name, pressed in buttons.items():
            gui.add_button(name).on_click(_for_client(pressed))
        with gui.add_folder("ranking", expand_by_default=False):
            self._ranking = gui.add_markdown("")

    def _draw_pose(self, session: Session) -> None:
        gui = self._gui
        self.numbers = {
            name: gui.add_number(label, 0.0, step=_ANGLE_STEP if name.endswith("_deg") else _LENGTH_STEP)
            for name, label in _POSE_LABELS.items()
        }
        known = dict.fromkeys((*session.scene.used_sensors, *session.scenario.sensors, *CATALOGUE))
        self.sensor = gui.add_dropdown("sensor", tuple(known))
        for number in self.numbers.values():
            number.on_update(self._typed)
        self.sensor.on_update(self._typed)
        gui.add_button("Back to the candidate").on_click(lambda _: self._back())

    def _draw_layer(self, session: Session, frames: int) -> None:
        gui = self._gui
        self.layer = gui.add_dropdown("layer", tuple(LAYERS.values()), hint="What lies over the scene.")
        self.ring = gui.add_number("ring", 0, min=0, step=1)
        self.compared_site = gui.add_dropdown("beside", (_BEST_OTHER, *sorted(session.candidates)))
        self.frame = gui.add_slider("frame", 0, max(1, frames - 1), 1, 0)
        self.plays = gui.add_checkbox("play", False)
        self._legend = gui.add_html("")
        dark = gui.add_checkbox("dark", False)
        self._dark = dark
        self._on(self.layer, lambda: {"layer": _LAYER_NAMES[self.layer.value]})
        self._on(self.ring, lambda: {"ring": int(self.ring.value)})
        self._on(
            self.compared_site,
            lambda: {"beside": "" if self.compared_site.value == _BEST_OTHER else self.compared_site.value},
        )
        self._on(self.frame, lambda: {"frame": int(self.frame.value)})
        self._on(self.plays, dict)
        self._on(dark, lambda: {"is_dark": dark.value})

    def _draw_settings(self, session: Session, effects: dict[str, str]) -> None:
        gui, asked = self._gui, session.scenario.score.additional
        scores = dict.fromkeys((*_FIRST_SCORES, *asked, *get_args(OtherScore)))
        self.score = gui.add_dropdown("score", tuple(scores), hint="By which candidates are ranked.")
        self.gamma = gui.add_number("gamma", 0.0, min=0.0, step=0.1, hint="More beams in a voxel count no more.")
        self.effects = {name: gui.add_checkbox(name, False, hint=why) for name, why in effects.items()}
        self.period = gui.add_dropdown("period", (_ALL_PERIODS, *session.periods), visible=bool(session.periods))
        for control in (self.score, self.gamma, *self.effects.values()):
            self._on(control, self._settings)
        self._on(self.period, lambda: {"period": "" if self.period.value == _ALL_PERIODS else self.period.value})

    def show(self, session: Session, view: View, rating: PoseScore, text: str, legend: str | None) -> None:
        """Bring all controls to what is shown; the legend stays as it is where it is None."""
        if session is not self._session or not self._sites:
            self._sites = {candidate_label(its, session.rank_by): its.site for its in session.ranked}
            self._site.options = tuple(self._sites)
            self._ranking.content = ranking_table(session.ranked, session.rank_by)
        if view.is_dark != self._view.is_dark:
            self._theme(view.is_dark)
        self._session, self._view = session, view
        self.status.content = text
        _set_silently(self._site, next(choice for choice, site in self._sites.items() if site.name == view.site.name))
        _set_silently(self.sensor, view.site.sensor)
        for name, value in asdict(view.site.pose).items():
            _set_silently(self.numbers[name], value)
        self._show_layer(view, legend)
        _set_silently(self.score, session.rank_by)
        _set_silently(self.gamma, session.scenario.gamma)
        _set_silently(self.period, view.period or _ALL_PERIODS)
        for name, control in self.effects.items():
            _set_silently(control, name in view.settings.effects)

    def _show_layer(self, view: View, legend: str | None) -> None:
        _set_silently(self.layer, LAYERS[view.layer])
        _set_silently(self.ring, view.ring)
        _set_silently(self.frame, min(view.frame, self.frame.max))
        _set_silently(self.compared_site, view.beside or _BEST_OTHER)
        _set_silently(self._dark, view.is_dark)
        for control, layer in ((self.ring, "ring"), (self.compared_site, "difference"), (self.frame, "replay")):
            if control.visible != (view.layer == layer):
                control.visible = view.layer == layer
        if self.plays.visible != self.frame.visible:
            self.plays.visible = self.frame.visible
        if legend is not None and self._legend.content != legend:
            self._legend.content = legend

    # ---- what somebody does

    def _on(self, control: Any, changes: Callable[[], dict[str, Any]]) -> None:
        """Ask for changes when somebody, not this program, has set a control."""
        control.on_update(lambda event: self._page.ask(**changes()) if event.client is not None else None)

    def _chosen(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        site = self._sites.get(event.target.value)
        if event.client is not None and site is not None:
            self._page.ask(site=self._page.present(site))

    def _typed(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            values = {name: float(number.value) for name, number in self.numbers.items()}
            self._page.ask(site=replace(self._view.site, pose=Pose(**values), sensor=self.sensor.value))

    def _back(self) -> None:
        self._page.ask(site=self._session.candidates[self._view.site.name].site)

    def _settings(self) -> dict[str, Settings]:
        own, its = self._session.scenario.gamma, self._view.settings
        gamma = its.gamma if float(self.gamma.value) == own else float(self.gamma.value)
        left = its.effects - self.effects.keys()
        ticked = {name for name, control in self.effects.items() if control.value}
        return {"settings": Settings(gamma, self.score.value, left | ticked)}

    def _theme(self, is_dark: bool) -> None:
        self._gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=is_dark)


def _for_client(pressed: Callable[[viser.ClientHandle], None]) -> Callable[[Any], None]:
    """What a button does for the browser that pressed it."""
    return lambda event: pressed(event.client) if event.client is not None else None


def _set_silently(control: Any, value: str | float | bool) -> None:
    """Show another value; viser's types have it that nobody may."""
    if control.value != value:
        control.value = value


def show_modal(
    client: viser.ClientHandle, title: str, texts: Sequence[str], answers: dict[str, Callable[[], None]]
) -> None:
    """Tell one browser something, and ask what to do; any answer closes it."""
    window = client.gui.add_modal(title)
    with window:
        for text in texts:
            client.gui.add_markdown(text)
        for name, act in answers.items():
            client.gui.add_button(name).on_click(_close_and_run(window, act))


def _close_and_run(window: Any, act: Callable[[], None]) -> Callable[[Any], None]:
    def answered(_: Any) -> None:
        window.close()
        act()

    return answered
