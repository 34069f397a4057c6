"""Page 2: the bucket, how the portion is released, and the load cell."""

import re
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from nicegui import events, ui

from dem_jax.app import facts
from dem_jax.app.design import (
    CELL_FIELDS,
    RELEASE_FIELDS,
    drop_wrong_changes,
    read_number,
    write_bucket,
)
from dem_jax.app.facts import BucketStlFacts
from dem_jax.app.folder import BUCKETS
from dem_jax.app.pages import parts
from dem_jax.app.pages.uploads import show_stl_upload, show_unit
from dem_jax.app.session import Session
from dem_jax.errors import RecordError, SceneError
from dem_jax.scene import Scene

Action = Callable[[], Awaitable[None]]
LONGEST = 400  # ms of the timeline of the flaps
PLACE_HINTS = (
    "From the middle of its mouth under the feed bucket.",
    "From the middle of its mouth under the feed bucket.",
    "Up, from where its lowest point is at the drop height.",
)


class Place(NamedTuple):
    """The fields of an STL bucket's place.

    move: takes by how much (m) it is dragged, and whether the drag ends. tell: takes why it cannot
    be there; "": it can.
    """

    move: Callable[[Sequence[float], bool], Awaitable[None]]
    tell: Callable[[str], None]


async def show_bucket(session: Session) -> None:
    """The page."""
    parts.show_title(
        "Bucket and release",
        "Choose where the portion falls, from how high and how fast the flaps open.",
    )
    with ui.element("div").classes("columns"):
        form = ui.element("section").classes("wide")
        with ui.element("section").classes("side").props('aria-label="Buckets in 3-D"'):
            with ui.element("div").classes("view").props("id=bucket-place") as place:
                view = parts.show_view("bucket-view", "Buckets in 3-D; the time moves the flaps")
            notes = ui.element("div").props("aria-live=polite")
            command = ui.element("div")

    seen: list[str] = []  # the bucket in the 3-D view
    places: list[Place] = []  # of the bucket that can be dragged

    async def show_view() -> None:
        text = session.design.to_toml()
        command.clear()
        with command:
            parts.show_command([session.next_command()])
            with ui.expansion("The scene file").classes("more"):
                parts.show_code(text)
        try:
            found = await session.workspace.helper.ask(
                facts.describe_scene, text, str(session.folder.root)
            )
        except RecordError as error:
            if notes.is_deleted:
                return
            notes.clear()
            with notes:
                parts.show_error(str(error))
            return
        if notes.is_deleted or text != session.design.to_toml():
            return  # a later change has a view of its own
        key = session.workspace.keep_view(found.view)
        moves = "&moves" if session.design.bucket.endswith(".toml") else ""
        keeps = "&keeps" if seen == [session.design.bucket] else ""
        seen[:] = [session.design.bucket]
        parts.change_view(view, f"source=/preview/{key}{keeps}{moves}")
        for fields in places:
            fields.tell(found.error)
        notes.clear()
        with notes:
            if found.error:
                parts.show_error(found.error)
            parts.show_lines(session.folder.shorten_paths(found.notes))

    async def refresh() -> None:
        form.clear()
        with form:
            places.clear()
            await _show_form(session, refresh, show_view, places.append)
        await show_view()

    async def move_bucket(event: events.GenericEventArguments) -> None:
        *by, is_over = event.args["detail"]
        for fields in places:
            await fields.move(by, is_over)

    place.on("bucketmoved", move_bucket, ["detail"])

    await refresh()


async def _show_form(
    session: Session, refresh: Action, show_view: Action, follow: Callable[[Place], None]
) -> None:
    """Bucket, release and load cell."""
    try:
        scene = drop_wrong_changes(session.design, session.folder.root).read_scene(
            session.folder.root
        )
    except SceneError as error:
        parts.show_error(str(error))
        return
    parts.show_heading("Bucket")
    names = {"": "The paper's: 2.7 litres"}
    names |= {name: f"Your own: {Path(name).stem}" for name in session.folder.list_buckets()}
    names |= {
        card.name: f"{card.litres:.2g} litres: {card.text}"
        for card in await session.workspace.list_buckets()
    }

    async def choose(event: events.ValueChangeEventArguments) -> None:
        session.design = session.design.with_bucket(event.value)
        await refresh()

    ui.select(names, value=session.design.bucket, label="Bucket", on_change=choose).props(
        "outlined"
    ).classes("wide-field")
    if session.design.bucket.endswith(".toml"):
        follow(_show_place(session, scene, show_view))
    with ui.expansion("Your own weigh bucket from an STL file").classes("more"):
        _show_upload(session, refresh)
    parts.show_heading("Release")
    fields = parts.Fields(session, show_view)
    fields.show(RELEASE_FIELDS, scene)
    _show_timeline(scene, fields)
    parts.show_heading("Load cell")

    async def hang(event: events.ValueChangeEventArguments) -> None:
        session.design = replace(session.design, has_load_cell=event.value)
        await refresh()

    with ui.element("div"):
        ui.switch(
            "The weigh bucket hangs on a load cell",
            value=session.design.has_load_cell,
            on_change=hang,
        )
    if session.design.has_load_cell:
        parts.Fields(session, show_view).show(CELL_FIELDS, scene)
    ui.button("Next: drop", on_click=lambda: ui.navigate.to("/drop")).props("no-caps unelevated")


def _show_place(session: Session, scene: Scene, show_view: Action) -> Place:
    """Where an STL bucket of one's own is, in numbers."""
    assert scene.weigh_bucket is not None
    of_file = scene.weigh_bucket.move
    at = session.design.move or of_file
    parts.show_text("p", "Where it is: drag it in the 3-D view, or by numbers.").classes("small")
    boxes = []
    with ui.element("div").classes("fields"):
        for axis, value, hint in zip("xyz", at, PLACE_HINTS, strict=True):
            box = ui.number(f"Move along {axis} (mm)", value=round(1e3 * value, 3), step=1)
            box.props("outlined dense debounce=300").classes("field").props["hint"] = hint
            boxes.append(box)
    begun: dict[str, list[float] | None] = {"at": None}  # when it is dragged, (mm)

    async def take() -> None:
        if begun["at"] is not None or any(box.value is None for box in boxes):
            return
        x, y, z = (round(1e-3 * float(box.value), 6) for box in boxes)
        if (x, y, z) != (session.design.move or of_file):
            session.design = replace(session.design, move=(x, y, z))
            await show_view()

    async def move(by: Sequence[float], is_over: bool) -> None:
        first = begun["at"] = begun["at"] or [float(box.value or 0) for box in boxes]
        for box, value, step in zip(boxes, first, by, strict=True):
            box.value = round(value + 1e3 * step, 3)
        if is_over:
            begun["at"] = None
            await take()

    def tell(error: str) -> None:
        words = re.sub(r" \([^)]*\)", "", error.partition(": ")[2].partition("; allowed")[0])
        # the mouth of the feed bucket is above the weigh bucket, or it is not: x and y
        for box in boxes[:2]:
            box.error = words or None

    for box in boxes:
        box.on_value_change(take)
    return Place(move, tell)


def _show_timeline(scene: Scene, fields: parts.Fields) -> None:
    """When the feed flaps begin to open and when they are open, to be dragged."""
    start = 1e3 * (read_number(scene, "feed_bucket.opening_start") or 0.0)
    end = start + 1e3 * (read_number(scene, "feed_bucket.opening_time") or 0.0)
    ui.label("The feed flaps, to be dragged (ms after the release)").classes("field-title")
    most = max(LONGEST, end)
    begins = parts.show_slider("Flaps begin to open", 0, most, 1, start)
    ends = parts.show_slider("Flaps are open", 0, most, 1, end)

    def drag(changed: ui.slider, event: events.GenericEventArguments) -> None:
        times = {slider: float(slider.value) for slider in (begins, ends)}
        times[changed] = float(event.args)  # its value may follow a moment later
        low, high = sorted(times.values())
        fields.set_value("feed_bucket.opening_start", low)
        fields.set_value("feed_bucket.opening_time", max(high - low, 1.0))

    for slider in (begins, ends):
        slider.on("change", partial(drag, slider))


def _show_upload(session: Session, refresh: Action) -> None:
    """An STL file that becomes a weigh bucket."""
    show_stl_upload(
        session,
        BUCKETS,
        "Drop an STL file of the bucket here",
        facts.describe_bucket_stl,
        lambda name, found: _show_stl(session, name, found, refresh),
    )


def _show_stl(session: Session, name: str, found: BucketStlFacts, refresh: Action) -> None:
    """What an STL of a bucket holds, its unit and where it is."""
    stem = Path(name).stem
    with ui.element("div").classes("panel"):
        parts.show_heading(f"Read: {stem}")
        parts.show_lines(
            [
                f"{' × '.join(f'{edge:.4g}' for edge in found.size)} units of the file",
                *session.folder.shorten_paths(found.notes),
            ]
        )
        unit = show_unit(found.unit)
        turns, moves = [], []
        with ui.element("div").classes("fields"):
            for axis in "xyz":
                box = ui.number(f"Turn about {axis} (°)", value=0, step=90)
                turns.append(
                    box.props(
                        'outlined dense hint="Applied first, about x, then y, then z."'
                    ).classes("field")
                )
            for axis in "xyz":
                box = ui.number(f"Move along {axis} (mm)", value=0, step=5)
                moves.append(
                    box.props(
                        'outlined dense hint="From the middle under the feed bucket."'
                    ).classes("field")
                )
        wrong = ui.label().classes("error").props("role=alert")

        async def use() -> None:
            wrong.set_text("")
            turn = [float(box.value or 0) for box in turns]
            move = [1e-3 * float(box.value or 0) for box in moves]
            bucket = f"{BUCKETS}/{stem}.toml"
            before = session.design
            try:
                session.folder.replace_text(
                    bucket, write_bucket(f"{stem}.stl", unit.value, turn, move, True)
                )
                session.design = session.design.with_bucket(bucket)
                text = session.design.to_toml()
                scene = await session.workspace.helper.ask(
                    facts.describe_scene, text, str(session.folder.root)
                )
                if scene.error:
                    raise SceneError(scene.error)
            except (RecordError, SceneError) as error:
                session.design = before
                session.folder.find_path(bucket).unlink(missing_ok=True)
                wrong.set_text(str(error))
                return
            await refresh()

        ui.button("Use this bucket", on_click=use).props("no-caps unelevated")
