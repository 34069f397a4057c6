"""An STL file that a person gives: its upload and the choice of its unit."""

from collections.abc import Callable
from typing import TypeVar

from nicegui import events, ui

from dem_jax.app.folder import LARGEST_STL
from dem_jax.app.pages import parts
from dem_jax.app.session import Session
from dem_jax.errors import RecordError

Facts = TypeVar("Facts")  # of a file
UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 1.0: "metres", 25.4e-3: "inches"}


def show_stl_upload(
    session: Session,
    folder: str,
    prompt: str,
    describe: Callable[[str], Facts],
    show: Callable[[str, Facts], None],
) -> None:
    """A place for an STL file, and below it what is asked about the file.

    Args:
        session: of the tab.
        folder: where the file is kept, relative to that of the app.
        prompt: what to drop.
        describe: reads a path, in the process of the helper. Raises RecordError.
        show: takes the name of the file in the folder of the app, and what was read.
    """
    form = ui.element("div")

    async def receive(event: events.UploadEventArguments) -> None:
        form.clear()
        with form:
            try:
                name = session.folder.store_upload(folder, event.file.name, await event.file.read())
                path = session.folder.find_path(name)
            except RecordError as error:
                parts.show_error(str(error))
                return
            try:
                show(name, await session.workspace.helper.ask(describe, str(path)))
            except RecordError as error:
                path.unlink(missing_ok=True)  # nothing can be made of it
                parts.show_error(str(error))

    parts.show_upload(prompt, LARGEST_STL, receive)
    form.move(target_index=-1)


def show_unit(guess: float) -> ui.select:
    """The choice of the unit of a file, m per unit."""
    box = ui.select(UNITS, value=guess, label="Unit of the file")
    return box.props("outlined dense").classes("field")
