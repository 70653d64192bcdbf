"""``egvs what-if``: whether parked vehicles, works or growing trees change the ranking."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from egvs.cli import options
from egvs.cli.options import Detector, Set, SettingsPath
from egvs.core.wording import format_percent

if TYPE_CHECKING:
    from egvs.studies.what_if import SiteScores, WhatIfAnswer, WhatIfResult, WhatIfRun

_WIDTH = 190

_Values = Callable[["SiteScores"], tuple[float | None, ...]]


def what_if(
    scenario: SettingsPath,
    detector: Detector = None,
    set_: Set = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Evaluate only the table \\[what_if.NAME] (repeatable); all by default."),
    ] = None,
) -> None:
    """What if a lorry parks there? Score the sites with the solids of tables \\[what_if.NAME] of scenario.toml."""
    from egvs.cli.console import ProgressDisplay, print_sentences

    with ProgressDisplay("what-if") as screen:
        from egvs.studies import what_if as study

        prepared = study.prepare_runs(scenario, options.with_detector(set_, detector), only or [])
        total = len(prepared)
        width = max(len(_run_label(what_if_run)) for what_if_run in prepared)

        def run_one(number: int, what_if_run: WhatIfRun) -> None:
            label = _run_label(what_if_run)
            title = f"{label} ({number} of {total})"
            screen.run_part(title, f"{label:<{width}}", what_if_run.scenario, what_if_run.folder)

        result = study.compare_runs(prepared, run_one)
        written = study.record_answers(result)
        screen.end_parts("what-if")
    print_what_if(result)
    print_sentences(describe_plan(result))
    for path in written:
        print(path)


def describe_plan(result: WhatIfResult) -> Iterator[str]:
    """Yield what the solids of each table change of the plan of the run, if it has one of its present stages."""
    from egvs.artefacts.run_folder import RunFolder
    from egvs.artefacts.run_record import RunRecord
    from egvs.core.digests import use_digests
    from egvs.placement.changed_plan import describe_in_other_world
    from egvs.results.plans import SensorPlan
    from egvs.runs.run import lock_run_folder
    from egvs.runs.run_context import open_folder
    from egvs.runs.stage_registry import recorded_digests

    base, *others = result.runs
    with lock_run_folder(base.folder):
        plan = SensorPlan.read(RunFolder(base.folder))
        if plan is None or not plan.belongs_to(RunRecord.read(base.folder).stages):
            return
        context, *changed = (
            open_folder(each.scenario, each.folder, recorded=recorded_digests(RunRecord.read(each.folder)))
            for each in result.runs
        )
        with use_digests(context.inputs.digests):
            for what_if_run, other, answer in zip(others, changed, result.answers, strict=False):
                sentence = describe_in_other_world(context, plan, other, answer.impossible)
                yield f"With {what_if_run.name}, {sentence}"


def _run_label(what_if_run: WhatIfRun) -> str:
    return what_if_run.name or "as it is"


def print_what_if(result: WhatIfResult) -> None:
    """Print the scores of the best sites, the answer of each table, and notes."""
    from egvs.cli.console import Column, console, make_table, percent_or_dash, print_sentences
    from egvs.results.labels import format_probability
    from egvs.results.sensors import difference_unit, format_difference
    from egvs.studies.what_if import impossible_note

    label, best = result.label, result.best
    out = console(_WIDTH, soft_wrap=False)

    def score_cell(values: _Values, number: int) -> Callable[[SiteScores], str]:
        def cell(site: SiteScores) -> str:
            value = values(site)[number]
            return "-" if value is None else label.value(value)

        return cell

    columns: list[Column[SiteScores]] = [
        Column("site", lambda site: site.site, align="left"),
        Column("as it is", lambda site: label.value(site.before)),
    ]
    for number, what_if_run in enumerate(result.runs[1:]):
        columns.append(Column(f"with {what_if_run.name}", score_cell(lambda site: site.present, number)))
    for number, answer in enumerate(result.answers):
        columns.append(Column(f"expected, {_share(answer)}", score_cell(lambda site: site.expected, number)))
    out.print(make_table(columns, result.sites, width=out.width, title=label.label))
    out.print()

    answers: list[Column[WhatIfAnswer]] = [
        Column("what if", lambda answer: answer.name, align="left"),
        Column("share of time", lambda answer: percent_or_dash(answer.share, 0)),
        Column("best before", lambda answer: answer.best_before, align="left"),
        Column("best with it", lambda answer: answer.best_present or "-", align="left"),
        Column("best expected", lambda answer: answer.best_expected, align="left"),
        Column(
            f"change of {best.site}, {difference_unit(best)}",
            lambda answer: "-" if answer.change is None else format_difference(answer.change, best),
        ),
        Column("probability that another is better", _chance(format_probability)),
    ]
    out.print(make_table(answers, result.answers, width=out.width))
    out.print()
    print_sentences(answer.conclusion() for answer in result.answers)
    notes = [*result.notes, *filter(None, map(impossible_note, result.answers))]
    print_sentences(f"note: {note}" for note in notes)


def _share(answer: WhatIfAnswer) -> str:
    return answer.name if answer.share is None else f"{answer.name} {format_percent(answer.share, 0)}"


def _chance(format_probability: Callable[[float], str]) -> Callable[[WhatIfAnswer], str]:
    def cell(answer: WhatIfAnswer) -> str:
        if answer.change is None:
            return "certain"
        if answer.overtakes is None:
            return "-"
        return f"{format_probability(answer.overtakes)} ({answer.rival})"

    return cell
