"""The panel beside the scene: its controls, and its texts in markdown.

Controls only request changes (:meth:`PageActions.request`); the page then shows its new state with
:meth:`Controls.show`. So all browsers show the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Protocol, get_args

import viser

from egvs.core.wording import format_percent
from egvs.explore.session import MovingPlan, PoseScore, Session
from egvs.explore.settings import Settings
from egvs.explore.view_state import LAYERS, View
from egvs.results.labels import SCORE_LABELS
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED, RankingScore
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose, Site

MAX_LISTED = 20
"""Rows of the ranking; the dropdown lists all candidates."""

WORKING_TITLE = "## computing ..."
"""Shown while stages run with other settings."""

_MARKDOWN_ESCAPES = str.maketrans({sign: f"\\{sign}" for sign in "\\`*_{}[]()<>#+-.!|"})

_POSE_LABELS = {
    "x_m": "x (m)",
    "y_m": "y (m)",
    "z_m": "z (m)",
    "yaw_deg": "yaw (°)",
    "pitch_deg": "pitch (°)",
    "roll_deg": "roll (°)",
}
_LENGTH_STEP, _ANGLE_STEP = 0.001, 0.01
_ALL_PERIODS, _BEST_OTHER = "all periods", "best other site"
_LAYERS_BY_LABEL = {label: name for name, label in LAYERS.items()}
_FIRST_SCORES = ("expected_detections", "egvs", "points_on_target")
_SLIDER_MARGIN_M = 6.0
"""The slider reaches this far above the highest candidate."""

HELP = (
    "**Move the sensor**: drag the coloured arrows and squares; drag the rings to turn it. Or use the height slider and"
    " the numbers under *pose*.",
    "**Other sites**: click a ball, or choose from the list *site*, the best first. Darker balls have higher scores.",
    "**Look around**: left button turns, right button moves, wheel zooms. The orange box is the region of interest.",
    "**Layers** colour the road: where traffic is, what the sensor sees, which vehicles it misses.",
    "**A second sensor**: *Add the best next sensor* shows which candidate adds most to the selected one.",
    "**Keep a result**: *Save this pose* adds it to a sites file; *Link to this view* restores everything later.",
)
"""How to use the page, in markdown."""


def describe_score(rating: PoseScore, rank_by: str, candidate: PoseScore, candidates: int) -> str:
    """Describe the scores of a sensor, or why it cannot be mounted there; what people notice beside what is found.

    Parameters
    ----------
    rating
        The sensor in its current pose.
    rank_by
        The score that ranks.
    candidate
        Its candidate, to compare with.
    candidates
        Number of candidates.
    """
    findings = []
    for finding in rating.findings:
        title = "**error:**" if finding.is_error else "**warning:**"
        findings.append(f"- {title} {escape_markdown(str(finding))}")
    findings_text = "\n".join(findings)
    if not rating.is_feasible:
        return f"## no score\n\n{findings_text}"

    label = SCORE_LABELS[rank_by]
    title = f"{format_score(rank_by, rating.scores[rank_by])} {label.head if label.is_share else ''}".strip()
    before = candidate.scores[rank_by]
    if before > 0.0 and rating.site.pose != candidate.site.pose:
        title += f" ({format_percent(rating.scores[rank_by] / before - 1.0, signed=True)})"
    if rank_by == DEFAULT_SCORE and NOTICED in rating.scores:
        noticed = SCORE_LABELS[NOTICED]
        title += f", {noticed.value(rating.scores[NOTICED])} {noticed.head}"
    rows = [f"| {plain_name(name)} | {format_score(name, value)} |" for name, value in rating.scores.items()]
    rank = f"rank {rating.rank} of {candidates} by {plain_name(rank_by)}"
    return "\n".join([f"## {title}\n\n{rank}\n\n| score | value |\n|---|---|", *rows, "", findings_text])


def describe_drawn_triangles(drawn: int, triangles: int) -> str:
    """Say that the static world is simplified for drawing; empty if it is not."""
    if drawn >= triangles:
        return ""
    return f"The drawing is simplified to {drawn:,} of {triangles:,} triangles; scores use all of them."


def describe_plan(plan: MovingPlan) -> str:
    """Describe the joint score of a plan with its current poses, and the best additional sensor."""
    names = ", ".join(map(escape_markdown, plan.sites))
    score = plan.poses.placement_problem.score
    text = f"\n\n**plan** {names}: {plain_name(score)} {format_score(score, plan.joint)} together"
    if plan.best_next is not None:
        name, gain = plan.best_next
        text += f"; best next: {escape_markdown(name)} (+{format_score(score, gain)})"
    elif plan.forbids_more:
        text += f"; {escape_markdown(plan.forbids_more)} allows no further sensor"
    return text


def ranking_table(ranked: Sequence[PoseScore], rank_by: str) -> str:
    """Return the best candidates as a table.

    Parameters
    ----------
    ranked
        Candidates, best first.
    rank_by
        The score that ranks.
    """
    lines = [f"| rank | site | {plain_name(rank_by)} |", "|---|---|---|"]
    for candidate in ranked[:MAX_LISTED]:
        score = format_score(rank_by, candidate.scores[rank_by])
        lines.append(f"| {candidate.rank} | {escape_markdown(candidate.site.name)} | {score} |")
    if len(ranked) > MAX_LISTED:
        lines.append(f"\n... and {len(ranked) - MAX_LISTED:,} more")
    return "\n".join(lines)


def candidate_label(candidate: PoseScore, rank_by: str) -> str:
    """Return a line of the list of candidates."""
    return f"{candidate.rank}. {candidate.site.name}: {format_score(rank_by, candidate.scores[rank_by])}"


def plain_name(score: str) -> str:
    """Return the name of a score in words."""
    return SCORE_LABELS[score].noun.removeprefix("the ")


def format_score(name: str, value: float) -> str:
    """Return a score with its unit and as many digits as a planner needs."""
    label = SCORE_LABELS[name]
    if label.is_share:
        return format_percent(value)
    number = f"{value:,.1f}" if abs(value) >= 100.0 else f"{value:.4g}"
    return f"{number} {label.unit}".strip()


def escape_markdown(text: str) -> str:
    """Return a text that markdown shows unchanged."""
    return text.translate(_MARKDOWN_ESCAPES).replace("\n", " ")


class PageActions(Protocol):
    """What controls need of the page."""

    def request(self, **changes: Any) -> None:
        """Request changes of the view: fields of :class:`egvs.explore.view_state.View`."""

    def current_site(self, candidate: Site) -> Site:
        """Return where a candidate's sensor is now."""

    def add_sensor(self) -> None:
        """Request the best additional sensor."""

    def reset_plan(self) -> None:
        """Request the plan of the run folder."""


@dataclass(frozen=True)
class PanelContent:
    """What a panel shows besides the session.

    Attributes
    ----------
    effects
        Effects that can be switched, with the reason.
    frames
        Number of recorded frames.
    buttons
        Actions of a browser, by the text of their button.
    note
        Markdown below the layers; empty for none.
    """

    effects: Mapping[str, str]
    frames: int
    buttons: Mapping[str, Callable[[viser.ClientHandle], None]]
    note: str


class Controls:
    """The panel.

    Parameters
    ----------
    gui
        The page's panel.
    session, view
        As the page is opened.
    page
        Receives requests.
    content
        What else the panel shows.

    Attributes
    ----------
    site, sensor, height, numbers, layer, ring, compared_site, frame, plays, dark, score, gamma, effects, period
        The controls.
    status, legend, ranking
        Texts.
    """

    def __init__(
        self, gui: viser.GuiApi, session: Session, view: View, page: PageActions, content: PanelContent
    ) -> None:
        self._gui, self._session, self._view, self._page = gui, session, view, page
        self._set_theme(False)
        gui.main_panel.dock_right()
        self._sites: dict[str, Site] = {}
        self.site = gui.add_dropdown("site", ("",), hint="Candidates, best first.")
        self.site.on_update(self._on_site)
        self.status = gui.add_markdown("")
        gui.add_button("Help", color="gray").on_click(_client_callback(_show_help))
        with gui.add_folder("layer"):
            self._add_layer(content.frames)
            if content.note:
                gui.add_markdown(content.note)
        with gui.add_folder("pose"):
            self._add_pose()
        with gui.add_folder("scoring", expand_by_default=False):
            self._add_settings(content.effects)
        for name, action in content.buttons.items():
            gui.add_button(name).on_click(_client_callback(action))
        with gui.add_folder("plan"):
            gui.add_button("Add the best next sensor").on_click(lambda _: page.add_sensor())
            gui.add_button("Reset the plan", color="gray").on_click(lambda _: page.reset_plan())
        with gui.add_folder("ranking", expand_by_default=False):
            self.ranking = gui.add_markdown("")

    def _add_pose(self) -> None:
        gui, session = self._gui, self._session
        heights_m = [candidate.site.pose.z_m for candidate in session.candidates.values()]
        low_m, high_m = math.floor(session.scene.roi.origin_m[2]), math.ceil(max(heights_m) + _SLIDER_MARGIN_M)
        self.height = gui.add_slider("height (m)", float(low_m), float(high_m), 0.1, float(low_m))
        self._request_on_update(self.height, self._changed_height)
        self.numbers = {}
        for name, label in _POSE_LABELS.items():
            step = _ANGLE_STEP if name.endswith("_deg") else _LENGTH_STEP
            self.numbers[name] = gui.add_number(label, 0.0, step=step)
            self.numbers[name].on_update(self._on_pose)
        sensors = dict.fromkeys((*session.scene.used_sensors, *session.scenario.sensors, *CATALOGUE))
        self.sensor = gui.add_dropdown("sensor", tuple(sensors))
        self.sensor.on_update(self._on_pose)
        gui.add_button("Reset to the candidate's pose").on_click(self._on_back)

    def _add_layer(self, frames: int) -> None:
        gui = self._gui
        self.layer = gui.add_dropdown("layer", tuple(LAYERS.values()), hint="Data drawn over the scene.")
        self.ring = gui.add_number("ring", 0, min=0, step=1)
        self.compared_site = gui.add_dropdown("compare with", (_BEST_OTHER, *sorted(self._session.candidates)))
        self.frame = gui.add_slider("frame", 0, max(1, frames - 1), 1, 0)
        self.plays = gui.add_checkbox("play", False)
        self.legend = gui.add_html("")
        self.dark = gui.add_checkbox("dark", False)
        self._request_on_update(self.layer, lambda: {"layer": _LAYERS_BY_LABEL.get(self.layer.value, self.layer.value)})
        self._request_on_update(self.ring, lambda: {"ring": int(self.ring.value)})
        self._request_on_update(
            self.compared_site, lambda: {"beside": _name_or_empty(self.compared_site.value, _BEST_OTHER)}
        )
        self._request_on_update(self.frame, lambda: {"frame": int(self.frame.value)})
        self._request_on_update(self.plays, dict)
        self._request_on_update(self.dark, lambda: {"is_dark": self.dark.value})

    def _add_settings(self, effects: Mapping[str, str]) -> None:
        gui, session = self._gui, self._session
        names = (*_FIRST_SCORES, *session.scenario.score.additional, *get_args(RankingScore))
        scores = dict.fromkeys(name for name in names if name != NOTICED)
        self.score = gui.add_dropdown("score", tuple(scores), hint="Candidates are ranked by this score.")
        self.gamma = gui.add_number(
            "gamma", 0.0, min=0.0, step=0.1, hint="Beams beyond this number in a voxel do not count."
        )
        self.effects = {name: gui.add_checkbox(name, False, hint=why) for name, why in effects.items()}
        self.period = gui.add_dropdown("period", (_ALL_PERIODS, *session.periods), visible=bool(session.periods))
        for control in (self.score, self.gamma, *self.effects.values()):
            self._request_on_update(control, self._changed_settings)
        self._request_on_update(self.period, lambda: {"period": _name_or_empty(self.period.value, _ALL_PERIODS)})

    def show(self, session: Session, view: View, text: str, legend: str | None) -> None:
        """Set all controls to the state of the page.

        Parameters
        ----------
        session, view
            The state.
        text
            Markdown about the sensor.
        legend
            HTML; None to keep the current one.
        """
        if session is not self._session or not self._sites:
            self._sites = {candidate_label(one, session.rank_by): one.site for one in session.ranked}
            self.site.options = tuple(self._sites)
            self.ranking.content = ranking_table(session.ranked, session.rank_by)
        if view.is_dark != self._view.is_dark:
            self._set_theme(view.is_dark)
        self._session, self._view = session, view
        self.status.content = text
        if legend is not None:
            _set_if_changed(self.legend, "content", legend)
        candidate = session.candidates[view.site.name]
        _set_if_changed(self.site, "value", candidate_label(candidate, session.rank_by))
        _set_if_changed(self.sensor, "value", view.site.sensor)
        for name, value in asdict(view.site.pose).items():
            _set_if_changed(self.numbers[name], "value", value)
        _set_if_changed(self.height, "value", min(max(view.site.pose.z_m, self.height.min), self.height.max))
        self._show_layer(view)
        _set_if_changed(self.score, "value", session.rank_by)
        _set_if_changed(self.gamma, "value", session.scenario.gamma)
        _set_if_changed(self.period, "value", view.period or _ALL_PERIODS)
        for name, control in self.effects.items():
            _set_if_changed(control, "value", name in view.settings.effects)

    def _show_layer(self, view: View) -> None:
        _set_if_changed(self.layer, "value", LAYERS[view.layer])
        _set_if_changed(self.ring, "value", view.ring)
        _set_if_changed(self.frame, "value", min(view.frame, self.frame.max))
        _set_if_changed(self.compared_site, "value", view.beside or _BEST_OTHER)
        _set_if_changed(self.dark, "value", view.is_dark)
        _set_if_changed(self.ring, "visible", view.layer == "ring")
        _set_if_changed(self.compared_site, "visible", view.layer == "difference")
        _set_if_changed(self.frame, "visible", view.layer == "replay")
        _set_if_changed(self.plays, "visible", view.layer == "replay")

    # ---- what users do; viser reports changes by the program as well, without a client

    def _request_on_update(self, control: Any, make_changes: Callable[[], dict[str, Any]]) -> None:
        def update(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self._page.request(**make_changes())

        control.on_update(update)

    def _on_site(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        site = self._sites.get(event.target.value)
        if event.client is not None and site is not None:
            self._page.request(site=self._page.current_site(site))

    def _on_pose(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            pose = Pose(**{name: float(number.value) for name, number in self.numbers.items()})
            self._page.request(site=replace(self._view.site, pose=pose, sensor=self.sensor.value))

    def _changed_height(self) -> dict[str, Site]:
        pose = replace(self._view.site.pose, z_m=float(self.height.value))
        return {"site": replace(self._view.site, pose=pose)}

    def _on_back(self, _: viser.GuiEvent[Any]) -> None:
        self._page.request(site=self._session.candidates[self._view.site.name].site)

    def _changed_settings(self) -> dict[str, Settings]:
        settings = self._view.settings
        gamma = settings.gamma
        if float(self.gamma.value) != self._session.scenario.gamma:
            gamma = float(self.gamma.value)
        not_offered = settings.effects - self.effects.keys()
        selected = {name for name, control in self.effects.items() if control.value}
        return {"settings": Settings(gamma, self.score.value, not_offered | selected)}

    def _set_theme(self, is_dark: bool) -> None:
        self._gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=is_dark)


def _name_or_empty(label: str, default_label: str) -> str:
    return "" if label == default_label else label


def _client_callback(action: Callable[[viser.ClientHandle], None]) -> Callable[[Any], None]:
    """Return a callback of a button that passes the browser that pressed it."""

    def pressed(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            action(event.client)

    return pressed


def _set_if_changed(control: Any, attribute: str, value: object) -> None:
    """Set an attribute of a control; each assignment sends a message to all browsers."""
    if getattr(control, attribute) != value:
        setattr(control, attribute, value)


def _show_help(client: viser.ClientHandle) -> None:
    """Open a window that says how to use the page."""
    show_modal(client, "Help", HELP, {"Close": lambda: None})


def show_modal(
    client: viser.ClientHandle, title: str, texts: Sequence[str], answers: Mapping[str, Callable[[], None]]
) -> None:
    """Open a window in one browser.

    Parameters
    ----------
    client
        The browser.
    title
        Title of the window.
    texts
        Paragraphs in markdown.
    answers
        Actions by the text of their button; each closes the window.
    """
    window = client.gui.add_modal(title)
    with window:
        for text in texts:
            client.gui.add_markdown(text)
        for name, action in answers.items():
            client.gui.add_button(name).on_click(partial(_close_and_run, window, action))


def _close_and_run(window: Any, action: Callable[[], None], _: object) -> None:
    window.close()
    action()
