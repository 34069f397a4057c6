"""Parts that the pages share: headings, fields with unit and limits, commands to copy, the state of
a job, charts.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from nicegui import ui

from dem_jax.app.design import FIELDS, FieldText, find_field_errors, read_number
from dem_jax.app.facts import Curve
from dem_jax.app.jobs import Job, format_command
from dem_jax.app.session import Session
from dem_jax.errors import SceneError
from dem_jax.scene import Scene

COLOURS = ("#1d4ed8", "#c2410c", "#15803d", "#7e22ce", "#0e7490", "#a16207")
LEAST_IMPACT = 0.1  # of the greatest force: a strong one


def show_text(tag: str, text: str) -> ui.html:
    """A text in an element of HTML."""
    return ui.html(_escape(text), sanitize=False, tag=tag)


def show_title(title: str, lead: str) -> None:
    """The heading of a page and a sentence below it."""
    show_text("h1", title)
    ui.label(lead).classes("lead")


def show_heading(title: str) -> None:
    """The heading of a section."""
    show_text("h2", title)


def show_command(
    commands: Sequence[Sequence[str]], text: str = "The command behind this page"
) -> None:
    """Commands as they are typed in a shell, with a button that copies them."""
    lines = "\n".join(format_command(argv) for argv in commands)
    with ui.element("section").classes("command").props(f'aria-label="{text}"'):
        with ui.element("div").classes("command-head"):
            ui.label(text)
            copy = ui.button("Copy", on_click=lambda: ui.clipboard.write(lines)).props(
                "flat dense no-caps"
            )
            copy.props('aria-label="Copy the command"')
        show_code(lines)


def show_code(text: str) -> None:
    """A text in a fixed pitch, as it is."""
    show_text("pre", text).props("tabindex=0")


def show_lines(lines: Sequence[str], style: str = "notes") -> None:
    """Sentences as a list."""
    if lines:
        with ui.element("ul").classes(style):
            for line in lines:
                show_text("li", line)


def show_figure(name: str, words: str, job: Job) -> None:
    """A picture that a command drew, what it printed, and above it what it noted."""
    show_lines(job.notes)
    ui.html(f'<img alt="{words}" src="/files/{name}?inline=true">', sanitize=False).classes(
        "figure"
    )
    show_text("pre", "\n".join(job.lines)).props("tabindex=0")


def show_table(head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> None:
    """A table whose first column heads the rows."""
    cells = "".join(f"<th scope=col>{_escape(cell)}</th>" for cell in head)
    top = f"<thead><tr>{cells}</tr></thead>" if any(head) else ""
    body = "".join(
        f"<tr><th scope=row>{_escape(row[0])}</th>{''.join(f'<td>{_escape(cell)}</td>' for cell in row[1:])}</tr>"
        for row in rows
    )
    title = f"<caption>{_escape(caption)}</caption>" if caption else ""
    ui.html(f"<table>{title}{top}<tbody>{body}</tbody></table>", sanitize=False).classes(
        "table"
    ).props("tabindex=0")


def show_error(message: str) -> None:
    """What went wrong, read out at once."""
    ui.label(message).classes("error").props("role=alert")


def _escape(text: str) -> str:
    return (
        text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")
    )


class _Slider(ui.slider):
    """A slider whose value is set where it is dragged: an answer that comes late must not set it
    back, as it would be while an arrow key is held.
    """

    LOOPBACK = False


def show_slider(label: str, low: float, high: float, step: float, value: float) -> ui.slider:
    """A slider with its label before it and its value above its thumb."""
    with ui.element("div").classes("slider"):
        ui.label(label).classes("small")
        slider = _Slider(min=low, max=high, step=step, value=value)
        slider.props("label-always").props["aria-label"] = label
    return slider


def describe_errors(errors: dict[str, str]) -> str:
    """What is wrong, of ``find_field_errors``, in one line."""
    named = [f"{FIELDS[key].label}: {text}" if key else text for key, text in errors.items()]
    return "; ".join(named)


class Fields:
    """Number fields of the design of a session.

    changed: called after each change that the scene allows.
    """

    def __init__(self, session: Session, changed: Callable[[], Awaitable[None]]) -> None:
        self._session = session
        self._changed = changed
        self._inputs: dict[str, ui.number] = {}

    def show(
        self, texts: Sequence[FieldText], scene: Scene, notes: dict[str, str] | None = None
    ) -> None:
        """Show fields with the values of the design, or else of a scene. notes: key -> a further
        sentence below the field.
        """
        self._wrong = ui.label().classes("error").props("role=alert")
        with ui.element("div").classes("fields"):
            for text in texts:
                value = self._session.design.changes.get(text.key, read_number(scene, text.key))
                self._show_one(text, value, (notes or {}).get(text.key, ""))
        self._mark_errors()

    def _show_one(self, text: FieldText, value: float | None, note: str) -> None:
        shown = None if value is None else float(f"{value / text.factor:.6g}")
        hint = f"{text.sentence} Allowed: {text.allowed}.{f' {note}' if note else ''}"
        box = ui.number(
            text.title, value=shown, step=text.step, on_change=lambda e: self._change(text, e.value)
        )
        box.props("outlined dense debounce=300").classes("field").props["hint"] = hint
        self._inputs[text.key] = box

    async def _change(self, text: FieldText, shown: float | None) -> None:
        design = self._session.design
        if shown is None:
            self._session.design = design.with_change(text.key, None)
        else:
            value = float(f"{shown * text.factor:.12g}")
            plain = design.with_change(text.key, None)
            self._session.design = (
                plain
                if self._is_default(plain, text.key, value)
                else design.with_change(text.key, value)
            )
        if not self._mark_errors():
            await self._changed()

    def _mark_errors(self) -> dict[str, str]:
        """Say what is wrong at each field, and above them what is wrong elsewhere."""
        errors = find_field_errors(self._session.design, self._session.folder.root)
        for key, box in self._inputs.items():
            box.error = errors.get(key)
        elsewhere = describe_errors({k: v for k, v in errors.items() if k not in self._inputs})
        self._wrong.set_text(elsewhere)
        return errors

    def _is_default(self, design: Any, key: str, value: float) -> bool:
        try:
            return read_number(design.read_scene(self._session.folder.root), key) == value
        except SceneError:
            return False

    def set_value(self, key: str, shown: float) -> None:
        """Put a value into a field."""
        if key in self._inputs:
            self._inputs[key].value = shown


def show_job(
    session: Session, page: str, finished: Callable[[Job], Awaitable[None]], always: bool = False
) -> Callable[[Job], None]:
    """A place for the job of a page: its progress, the time left, a button that cancels it, and why
    it failed.

    Args:
        session: of the tab; its job of this page is taken up if it still runs.
        page: name of the place.
        finished: called once when a job has ended, unless it was cancelled or failed.
        always: whether it is called even then.

    Returns:
        A function that starts a job and shows it.
    """
    with ui.element("div").classes("job").props("role=status") as place:
        message = ui.label()
        with ui.element("div").classes("job-line"):
            bar = ui.linear_progress(0, show_value=False, size="10px").props(
                "rounded instant-feedback aria-label=Progress"
            )  # without graphics hardware an animation would take a core from the drop
            cancel = ui.button(
                "Cancel", on_click=lambda: session.workspace.runner.cancel(session.jobs[page])
            )
            cancel.props("outline no-caps")
    place.set_visibility(False)
    followed: dict[str, Job | None] = {"job": None}

    async def update() -> None:
        job = followed["job"]
        if job is None:
            return
        message.set_text(job.message)
        message.classes(replace="error" if job.state in ("failed", "cancelled") else "job-message")
        bar.set_value(1.0 if job.state == "done" else job.share or 0.0)
        bar.set_visibility(not job.is_over)
        cancel.set_visibility(job.state in ("waiting", "running"))
        if job.is_over:
            followed["job"] = None
            timer.deactivate()
            if job.state == "done" or always:
                await finished(job)

    timer = ui.timer(0.15, update, active=False)

    def follow(job: Job) -> None:
        followed["job"] = session.jobs[page] = job
        place.set_visibility(True)
        timer.activate()
        if job.state == "waiting":
            _keep(asyncio.get_running_loop().create_task(session.workspace.runner.follow(job)))

    if page in session.jobs and not session.jobs[page].is_over:
        follow(session.jobs[page])
    return follow


_TASKS: set[asyncio.Task[Any]] = set()


def _keep(task: asyncio.Task[Any]) -> None:
    """Keep a task until it is done: the loop itself does not."""
    _TASKS.add(task)
    task.add_done_callback(_TASKS.discard)


def show_view(name: str, title: str) -> ui.element:
    """A 3-D view. name: of its element, for app.js. title: what it shows."""
    view = ui.element("iframe").props(f'src="/player" title="{_escape(title)}"')
    view.props["id"] = name
    return view


def change_view(view: ui.element, source: str) -> None:
    """Show something else in a 3-D view. source: of its data, as player.js reads it; the one that
    is shown goes on.
    """
    if not view.is_deleted:
        name = json.dumps(view.props["id"])
        view.client.run_javascript(f"showView({name}, {json.dumps(source)})")


def show_chart(
    curves: Sequence[tuple[str, Curve | None, Curve | None]], height: str = "26rem"
) -> ui.echart:
    """The force and the settled mass over time, one below the other, with a cursor; (name, force,
    settled) of each run.
    """
    series: list[dict[str, Any]] = []
    for k, (name, force, settled) in enumerate(curves):
        colour = COLOURS[k % len(COLOURS)]
        for axis, curve in ((0, force), (1, settled)):
            if curve is not None:
                series.append(_make_series(name, curve, axis, colour))
    names = [name for name, _, _ in curves]
    options = _make_options(
        series,
        names,
        find_span([force for _, force, _ in curves], [settled for _, _, settled in curves]),
    )
    chart = ui.echart(options).classes("chart").style(f"height:{height}")
    chart.props(
        f'role=img aria-label="Force and settled mass over time: {_escape(", ".join(names))}"'
    )
    return chart


def _make_series(name: str, curve: Curve, axis: int, colour: str) -> dict[str, Any]:
    cursor = {
        "symbol": "none",
        "silent": True,
        "animation": False,
        "label": {"show": False},
        "data": [],
    }
    return {
        "name": name,
        "type": "line",
        "xAxisIndex": axis,
        "yAxisIndex": axis,
        "showSymbol": False,
        "lineStyle": {"width": 1.4, "color": colour},
        "itemStyle": {"color": colour},
        "data": [list(point) for point in zip(curve.time, curve.value, strict=True)],
        "markLine": {**cursor, "lineStyle": {"color": "#b91c1c", "type": "solid", "width": 1.5}},
    }


def find_span(
    forces: Sequence[Curve | None], settled: Sequence[Curve | None]
) -> tuple[float, float] | None:
    """The span (ms) from the first strong impact to the greatest force and to the last change of a
    settled mass, with something around it; None: nothing landed.
    """
    times = [
        time
        for curve in filter(None, settled)
        for time, before, after in zip(curve.time[1:], curve.value, curve.value[1:], strict=False)
        if before != after
    ]
    for curve in filter(None, forces):
        greatest = max(curve.value, default=0.0)
        if greatest > 0.0:
            strong = (k for k, x in enumerate(curve.value) if x > LEAST_IMPACT * greatest)
            times += [curve.time[k] for k in (next(strong), curve.value.index(greatest))]
    if not times:
        return None
    low, high = min(times), max(times)
    last = max(curve.time[-1] for curve in (*forces, *settled) if curve and curve.time)
    around = max(0.15 * (high - low), 10.0)
    return 10.0 * (max(low - around, 0.0) // 10.0), min(
        10.0 * ((high + around) // 10.0 + 1.0), last
    )


def _make_options(
    series: list[dict[str, Any]], names: Sequence[str], span: tuple[float, float] | None
) -> dict[str, Any]:
    words = {"color": "#334155", "fontSize": 12}
    time = {"type": "value", "axisLabel": words, "nameTextStyle": words}
    value = {"type": "value", "axisLabel": words, "nameTextStyle": {**words, "align": "left"}}
    shown = {} if span is None else {"startValue": span[0], "endValue": span[1]}
    return {
        "animation": False,
        "textStyle": {"fontFamily": "system-ui, sans-serif"},
        "legend": {"show": len(names) > 1, "top": 0, "type": "scroll"},
        "tooltip": {"trigger": "axis", "confine": True},
        "axisPointer": {"link": [{"xAxisIndex": "all"}]},
        "grid": [
            {"left": 56, "right": 18, "top": 52, "height": "41%"},
            {"left": 56, "right": 18, "bottom": 74, "height": "20%"},
        ],
        "xAxis": [
            {**time, "gridIndex": 0, "axisLabel": {"show": False}},
            {
                **time,
                "gridIndex": 1,
                "name": "ms after the release",
                "nameLocation": "middle",
                "nameGap": 24,
            },
        ],
        "yAxis": [
            {**value, "gridIndex": 0, "name": "force (kg)"},
            {**value, "gridIndex": 1, "name": "settled (g)", "splitNumber": 2},
        ],
        "dataZoom": [
            {"type": "inside", "xAxisIndex": [0, 1], "zoomOnMouseWheel": "ctrl", **shown},
            {"type": "slider", "xAxisIndex": [0, 1], "height": 16, "bottom": 14, **shown},
        ],
        "series": series,
    }


def list_results(session: Session) -> list[str]:
    """Names of the results in the folder, the newest first."""
    return session.folder.list_results()


def show_upload(text: str, largest: int, receive: Callable[[Any], Awaitable[None]]) -> None:
    """A place for one STL file: dropped there, or chosen by its button.

    Args:
        text: what to drop.
        largest: bytes.
        receive: takes the upload.
    """
    box = ui.upload(on_upload=receive, max_file_size=largest, auto_upload=True)
    box.props("accept=.stl flat bordered").classes("upload")
    button = '<q-btn unelevated no-caps icon="upload_file" label="Choose a file" @click="props.pickFiles" />'
    words = f'<span class="upload-text">{_escape(text)}</span>'
    box.add_slot(
        "header", f'<div class="upload-head">{button}{words}<q-uploader-add-trigger /></div>'
    )
    rejection = f"Allowed: an STL file of up to {largest // 2**20} MB"
    box.on("rejected", lambda: ui.notify(rejection, type="negative"))
