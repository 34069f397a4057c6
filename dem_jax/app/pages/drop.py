"""Page 3: the drop: one or many, its progress, the pieces in 3-D, the force and the numbers."""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from pathlib import Path

from nicegui import ui

from dem_jax.app import facts
from dem_jax.app.design import FIELDS, RUN_COUNTS, find_field_errors
from dem_jax.app.facts import RunFacts, ShareFacts
from dem_jax.app.jobs import Job
from dem_jax.app.pages import parts
from dem_jax.app.session import Session
from dem_jax.errors import RecordError, SceneError

WORDS = {1: "One drop", 16: "16 drops", 64: "64 drops"}
DRAW_WORDS = "Draw the product's unknown numbers"
DRAW_HINT = (
    "With its unknown numbers drawn from their ranges for each of several drops: "
    "what is chance of the fall, what is not known, and which number to measure first."
)
NO_RANGES = "No number of this product has a range, so that none can be drawn."


async def show_drop(session: Session) -> None:
    """The page."""
    has_ranges = _has_ranges(session)
    session.design = replace(session.design, uncertain=session.design.uncertain and has_ranges)
    parts.show_title("Drop", "Compute the drop, watch it, and read its numbers.")
    page = _DropPage(session, find_field_errors(session.design, session.folder.root))
    with ui.element("section").classes("panel").props('aria-label="Compute"'):
        with ui.element("div").classes("line"):
            _show_choices(session, has_ranges, page.show_command)
            page.show_start()
        ui.label(_describe_design(session)).classes("small")
        ui.label(DRAW_HINT if has_ranges else NO_RANGES).classes("small")
        page.show_progress()
    with ui.element("section").props('aria-label="Result"'):
        page.show_places()
    job = session.jobs.get("drop")
    if job is not None and not job.is_over:
        page.show_command()
        page.show_falling()
    else:
        await page.show_result()


def _show_choices(session: Session, has_ranges: bool, refresh: Callable[[], None]) -> None:
    """How many drops, the first seed, and whether unknown numbers are drawn."""
    design = session.design
    runs = ui.toggle({n: WORDS[n] for n in RUN_COUNTS}, value=design.runs)
    runs.props('no-caps unelevated aria-label="Number of drops"')
    seed = ui.number("First seed", value=design.seed, min=0, step=1, precision=0)
    seed.props(
        'outlined dense hint="Which arrangement of the pieces; of several drops each has the next."'
    ).classes("seed")
    drawn = ui.switch(DRAW_WORDS, value=design.uncertain)
    drawn.set_enabled(has_ranges and design.runs > 1)

    def change() -> None:
        number = int(seed.value or 0)
        session.design = replace(
            session.design, runs=int(runs.value), seed=max(number, 0), uncertain=drawn.value
        )
        drawn.set_enabled(has_ranges and session.design.runs > 1)
        refresh()

    for choice in (runs, seed, drawn):
        choice.on_value_change(change)


class _DropPage:
    """The parts of the page that change while a drop is computed."""

    def __init__(self, session: Session, errors: dict[str, str]) -> None:
        """errors: field -> why its value is impossible."""
        self._session = session
        self._errors = errors

    def show_start(self) -> None:
        """The button that begins."""
        self._start = ui.button("Drop", icon="play_arrow", on_click=self._begin)
        self._start.props("no-caps unelevated")
        ui.timer(0.2, self._wake)

    def show_progress(self) -> None:
        """What hinders a drop, how far it is, and its command."""
        if self._errors:
            parts.show_error(parts.describe_errors(self._errors))
        self._follow = parts.show_job(self._session, "drop", self._finish, always=True)
        self._command = ui.element("div")

    def show_places(self) -> None:
        """Places of the result."""
        head = ui.element("div")
        with ui.element("div").classes("halves"):
            with ui.element("div").classes("view"):
                self._view = parts.show_view("drop-view", "The drop in 3-D")
            self._chart = ui.element("div")
        self._places = (head, self._chart, ui.element("div"))

    def show_command(self) -> None:
        """The command of the drop that is computed, else of the next one."""
        self._command.clear()
        with self._command:
            job = self._session.jobs.get("drop")
            is_running = job is not None and not job.is_over
            shown = job.argv if job and is_running else self._session.next_command()
            parts.show_command([shown], "The command of this drop")

    def show_falling(self) -> None:
        """The drop that is computed, as far as it is."""
        for place in self._places:
            place.clear()
        with self._chart:
            ui.label("The pieces fall as they are computed; force and numbers follow.").classes(
                "lead"
            )
        source = find_source(self._session.opened_jobs["drop"], 0)
        parts.change_view(self._view, f"{source}&plays")

    async def show_result(self) -> None:
        """The file of results that is chosen."""
        await _show_result(self._session, self._view, self._places, self.show_result)
        self.show_command()

    async def _begin(self) -> None:
        try:
            job, name = self._session.enter_drop()
        except RecordError as error:
            ui.notify(str(error), type="negative")
            return
        self._session.opened_jobs["drop"] = name
        self._start.disable()
        self._follow(job)
        self.show_command()
        self.show_falling()

    async def _finish(self, job: Job) -> None:
        name = self._session.opened_jobs["drop"]
        path = self._session.folder.find_path(name)
        if path.is_file() and job.state == "cancelled":
            await self._session.workspace.helper.ask(facts.remove_empty_results, str(path))
        if path.is_file():
            self._session.shown, self._session.member = name, None
        await self.show_result()

    def _wake(self) -> None:
        job = self._session.jobs.get("drop")
        self._start.set_enabled(not self._errors and (job is None or job.is_over))


def _has_ranges(session: Session) -> bool:
    """Whether a number of what falls is known within a range."""
    try:
        return bool(session.design.read_scene(session.folder.root).uncertain)
    except SceneError:  # which the page shows
        return False


def find_source(name: str, member: int) -> str:
    """What the 3-D view shows of a file of results."""
    return f"source=/poses/{name}?member={member}"


def _describe_design(session: Session) -> str:
    """What falls, in words."""
    names = ", ".join(
        name.split("/")[-1].removesuffix(".toml") for name, _ in session.design.products
    )
    bucket = session.design.bucket.split("/")[-1].removesuffix(".toml") or "the paper's"
    changed = ", ".join(
        f"{FIELDS[key].label.lower()} {value / FIELDS[key].factor:g} {FIELDS[key].unit}".strip()
        for key, value in sorted(session.design.changes.items())
    )
    return f"{names} into bucket {bucket}{f'; {changed}' if changed else ''}"


async def _show_result(
    session: Session,
    view: ui.element,
    places: Sequence[ui.element],
    refresh: Callable[[], Awaitable[None]],
) -> None:
    """A file of results: which one, the drop, the force, the numbers.

    view: of the drop in 3-D. places: of the others.
    """
    head, chart, numbers = places
    for place in places:
        place.clear()
    names = parts.list_results(session)
    if session.shown not in names:
        session.shown, session.member = (names[0] if names else ""), None
    if not session.shown:
        with head:
            ui.label("Nothing has been dropped in this folder yet; a drop is seen here.").classes(
                "lead"
            )
        return

    async def choose(name: str) -> None:
        session.shown, session.member = name, None
        await refresh()

    with head:
        box = ui.select(
            names, value=session.shown, label="Result", on_change=lambda e: choose(e.value)
        )
        box.props("outlined dense").classes("wide-field")
    try:
        path = str(session.folder.find_path(session.shown))
        helper = session.workspace.helper
        found = await helper.ask(facts.describe_run, path, session.member)
        shares = await helper.ask(facts.describe_shares, path)
    except RecordError as error:
        with head:
            parts.show_error(str(error))
            _offer_scene(session)
        return
    if head.is_deleted:
        return  # another page is shown
    parts.change_view(view, find_source(session.shown, found.member))
    with head:
        if found.run_count > 1:
            _show_members(session, found.run_count, found.member, refresh)
    with chart:
        _show_curves(found)
    with numbers:
        _show_numbers(session, found, shares)


def _show_curves(found: RunFacts) -> None:
    """Force and settled mass, with a cursor that is joined with the 3-D view."""
    chart = parts.show_chart([(found.name, found.force, found.settled)])
    ui.run_javascript(f"followDrop({chart.id})")
    with ui.element("div").classes("line"):
        jump = ui.button("Jump to the peak", icon="bolt").props("outline no-caps")
        jump.on_click(lambda: ui.run_javascript(f"sendTime({found.peak_time})"))
        ui.label("Click into the force to see that instant.").classes("small")


def _show_numbers(session: Session, found: RunFacts, shares: ShareFacts | None) -> None:
    """Numbers with their bands, what they depend on, and where to go from here."""
    parts.show_table(
        ["number", "value"],
        found.numbers,
        "Numbers" if found.run_count == 1 else "Medians and bands",
    )
    if shares is not None:
        parts.show_heading(shares.title)
        if shares.picture:
            picture = f'<img alt="{shares.caption}" src="data:image/png;base64,{shares.picture}">'
            ui.html(picture, sanitize=False).classes("figure")
        parts.show_lines(shares.lines)
    parts.show_heading("What they depend on")
    parts.show_lines(session.folder.shorten_paths(found.notes))
    with ui.element("div").classes("line"):
        compare = ui.button("Next: compare", on_click=lambda: ui.navigate.to("/compare"))
        compare.props("no-caps unelevated")
        _offer_scene(session)


def _offer_scene(session: Session) -> None:
    """A button that takes up the scene of the shown result, whether that can be read or not."""
    if session.folder.find_path(f"{Path(session.shown).stem}.toml").is_file():
        again = ui.button("Take up this scene", on_click=lambda: _reopen(session))
        again.props("no-caps outline")


def _reopen(session: Session) -> None:
    """Take up the scene of the shown result, and go to its bucket and release."""
    try:
        session.reopen_scene(session.shown)
    except (RecordError, SceneError) as error:
        ui.notify(str(error), type="negative")
    else:
        ui.navigate.to("/bucket")


def _show_members(
    session: Session, count: int, member: int, refresh: Callable[[], Awaitable[None]]
) -> None:
    """Which run of an ensemble is shown."""

    async def choose(number: int) -> None:
        session.member = number
        await refresh()

    options = {k: f"Drop {k + 1} of {count}" for k in range(count)}
    box = ui.select(options, value=member, label="Shown drop", on_change=lambda e: choose(e.value))
    box.props('outlined dense hint="At first the one whose peak is the median."').classes("field")
