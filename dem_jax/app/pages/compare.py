"""Page 4: results over each other, and what another value would give."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from nicegui import ui

from dem_jax.app import facts
from dem_jax.app.design import FIELDS, read_number, write_study
from dem_jax.app.jobs import Job
from dem_jax.app.pages import parts
from dem_jax.app.session import Session
from dem_jax.errors import RecordError, SceneError

MOST_COMPARED = 6
DRAFT = (
    "For a quick answer it is computed with twice the default step (run.accuracy = draft), unless the scene says "
    "how long the step is; a drop of the page Drop is not."
)


class Question(NamedTuple):
    """A key that "what if" asks about. least, most: the widest range (SI). span: share of the value
    up and down at first.
    """

    key: str
    least: float
    most: float
    span: float


QUESTIONS = (
    Question("drop.height", 0.15, 0.6, 0.2),
    Question("feed_bucket.opening_time", 0.02, 0.4, 0.5),
    Question("feed_bucket.opening_angle_deg", 40.0, 90.0, 0.15),
    Question("material.restitution", 0.05, 0.95, 0.5),
)


async def show_compare(session: Session) -> None:
    """The page."""
    parts.show_title(
        "Compare", "Put results over each other, and ask what another value would give."
    )
    names = session.folder.list_results()
    session.compared = [name for name in session.compared if name in names] or names[1::-1]
    with ui.element("section").classes("panel").props('aria-label="Results"'):
        parts.show_heading("Results over each other")
        if len(names) < 2:
            ui.label("Two results are needed; compute another drop first.").classes("lead")
        result = ui.element("div")

        async def choose(chosen: list[str]) -> None:
            session.compared = chosen[:MOST_COMPARED]
            result.clear()
            with result:
                await _show_comparison(session)

        box = ui.select(
            names,
            multiple=True,
            value=session.compared,
            label="Results; the first is the reference",
        )
        box.props("outlined use-chips").classes("wide-field").on_value_change(
            lambda e: choose(list(e.value or []))
        )
        box.move(target_index=1)
        with result:
            await _show_comparison(session)
    await _show_question(session)


async def _show_comparison(session: Session) -> None:
    """Curves, differing keys and differences of the compared results."""
    if not session.compared:
        return
    paths = [str(session.folder.find_path(name)) for name in session.compared]
    try:
        runs = [
            await session.workspace.helper.ask(facts.describe_run, path, None) for path in paths
        ]
        found = await session.workspace.helper.ask(facts.compare_runs, paths)
    except RecordError as error:
        parts.show_error(str(error))
        return
    parts.show_chart([(run.name, run.force, run.settled) for run in runs])
    if any(run.run_count > 1 for run in runs):
        ui.label("Of several drops the curve is the one whose peak is the median.").classes("small")
    if len(runs) > 1:
        if found.keys:
            parts.show_table(
                ["key", *session.compared],
                [[key, *values] for key, values in found.keys],
                "Differing keys",
            )
        else:
            ui.label(
                "Their scenes have the same keys and values; they differ by their seeds."
            ).classes("small")
        parts.show_heading("By how much, and whether beyond chance")
        parts.show_lines(sorted(found.lines, key=lambda line: "chance" not in line))
    parts.show_command(
        [["dem-jax", "plot", *session.compared, "--out", "comparison.png"]],
        "The command of this comparison",
    )


async def _show_question(session: Session) -> None:
    """A small study of one key: drops at a few values, and the answer with its band."""
    with ui.element("section").classes("panel").props('aria-label="What if"'):
        parts.show_heading("What if …")
        try:
            scene = session.design.read_scene(session.folder.root)
        except SceneError as error:
            parts.show_error(str(error))
            return
        questions = {question.key: question for question in QUESTIONS}
        key = ui.select(
            {name: FIELDS[name].title for name in questions},
            value="drop.height",
            label="What changes",
        )
        key.props("outlined dense").classes("field")
        least = parts.show_slider("From", 0, 1, 0.01, 0)
        most = parts.show_slider("To", 0, 1, 0.01, 1)
        with ui.element("div").classes("line"):
            points = ui.select(
                {2: "2 values", 3: "3 values", 5: "5 values"}, value=3, label="Values"
            )
            points.props("outlined dense").classes("seed")
            drops = ui.select(
                {2: "2 drops", 4: "4 drops", 8: "8 drops"}, value=4, label="Drops at each value"
            )
            drops.props("outlined dense").classes("seed")
            start = ui.button("Find out", icon="query_stats").props("no-caps unelevated")
        ui.label(DRAFT).classes("small")
        command = ui.element("div")
        answer = ui.element("div").props("aria-live=polite")

        def set_range() -> None:
            question, text = questions[key.value], FIELDS[key.value]
            now = read_number(scene, key.value) or 0.0
            low = max(question.least, (1 - question.span) * now) / text.factor
            high = min(question.most, (1 + question.span) * now) / text.factor
            limits = {"min": question.least / text.factor, "max": question.most / text.factor}
            for slider, value in ((least, low), (most, high)):
                slider.props["step"] = 0.01 if text.unit == "" else 1
                slider.props["min"], slider.props["max"] = limits["min"], limits["max"]
                slider.value = round(value, 2)
                slider.update()

        def make_study(stem: str) -> str:
            text = FIELDS[key.value]
            low, high = sorted((least.value, most.value))
            shown = np.linspace(
                low, high if high > low else low + least.props["step"], points.value
            )
            values = [float(f"{each * text.factor:.6g}") for each in shown]
            return write_study(
                f"{stem}.toml", f"What if: {text.label.lower()}", key.value, values, drops.value
            )

        async def begin() -> None:
            try:
                stem = session.folder.reserve_stem(session.design.stem, session.design.to_toml())
                study = session.folder.reserve_stem(f"{stem}-what-if", make_study(stem))
            except RecordError as error:
                ui.notify(str(error), type="negative")
                return
            session.opened_jobs["study"] = study
            job = session.workspace.runner.enter(["dem-jax", "study", f"{study}.toml"])
            command.clear()
            with command:
                parts.show_command([job.argv], "The command of this study")
            follow(job)

        async def finish(job: Job) -> None:
            answer.clear()
            with answer:
                study = session.opened_jobs["study"]
                words = f"Answer of {Path(study).stem}: medians and 5 to 95 % bands"
                parts.show_figure(f"{study}.png", words, job)

        key.on_value_change(set_range)
        start.on_click(begin)
        set_range()
        follow = parts.show_job(session, "study", finish)
