"""What is around the pages: the name of the folder, the steps, and their contents."""

from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import ui

from dem_jax.app.pages.bucket import show_bucket
from dem_jax.app.pages.compare import show_compare
from dem_jax.app.pages.drop import show_drop
from dem_jax.app.pages.model import show_model
from dem_jax.app.pages.product import show_product
from dem_jax.app.session import Session

PAGES = {
    "/": ("Product", show_product),
    "/bucket": ("Bucket and release", show_bucket),
    "/drop": ("Drop", show_drop),
    "/compare": ("Compare", show_compare),
    "/model": ("Weigh and model", show_model),
}


def show_frame(session: Session) -> None:
    """The whole page of a tab."""
    ui.colors(primary="#1d4ed8", negative="#b91c1c", positive="#15803d")
    with ui.element("header").classes("top"):
        with ui.element("div").classes("top-line"):
            ui.label("dem-jax").classes("brand")
            ui.label(str(session.folder.root)).classes("place").tooltip(
                "Everything is kept in this folder"
            )
        with ui.element("nav").props('aria-label="Steps"').classes("steps"):
            for number, (path, (title, _)) in enumerate(PAGES.items(), 1):
                with ui.link(target=path).classes("step").props(f'data-path="{path}"'):
                    ui.label(str(number)).classes("step-number").props("aria-hidden=true")
                    ui.label(title)
    routes: dict[str, Callable[..., Any]] = {
        path: partial(_show_page, session, path) for path in PAGES
    }
    with ui.element("div").classes("content"):
        ui.sub_pages(routes)


async def _show_page(session: Session, path: str) -> None:
    """A page; its step is marked, and whether it is complete."""
    client = ui.context.client
    client.run_javascript(f"markStep({path!r})")
    try:
        await PAGES[path][1](session)
    finally:
        client.run_javascript(f"markComplete({path!r})")
