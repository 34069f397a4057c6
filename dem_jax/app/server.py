"""The server: routes of the pages, of views and of files, behind the guard."""

import asyncio
import html
import secrets
import socket
import sys
import webbrowser
from pathlib import Path
from typing import Any

from fastapi import Response
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse
from nicegui import app, ui

from dem_jax.app import facts
from dem_jax.app.access import AccessGuard
from dem_jax.app.folder import Folder
from dem_jax.app.pages.frame import show_frame
from dem_jax.app.session import Session, Workspace
from dem_jax.errors import RecordError

HOST = "127.0.0.1"
STATIC = Path(__file__).parent / "static"


def find_port(wanted: int) -> int:
    """The port that was asked for, or for 0 a free one. Raises RecordError for one that is taken."""
    with socket.socket() as probe:
        if sys.platform != "win32":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, wanted))
        except (OSError, OverflowError) as error:
            raise RecordError(
                f"--port {wanted}: it is taken; allowed: another port, or 0 for a free one"
            ) from error
        return int(probe.getsockname()[1])


def serve(folder: Folder, port: int, opens_browser: bool) -> None:
    """Serve the app until it is interrupted. Raises RecordError for a port that is taken."""
    port = find_port(port)
    token = secrets.token_urlsafe(24)
    address = f"http://{HOST}:{port}/?token={token}"
    workspace = Workspace(folder)
    # A bar over the page while files load has no name that a screen reader could tell.
    app.config.quasar_config["loadingBar"]["skipHijack"] = True
    app.add_middleware(AccessGuard, token=token, port=port)
    add_routes(workspace)

    def announce() -> None:
        print(f"dem-jax app of {folder.root}\n{address}\nCtrl+C ends it.", flush=True)
        if opens_browser:
            asyncio.get_running_loop().run_in_executor(None, webbrowser.open, address)

    app.on_startup(announce)
    app.on_startup(workspace.start)
    app.on_shutdown(workspace.close)

    async def show_root() -> None:
        await ui.context.client.connected()
        stored: Any = app.storage.tab
        if "session" not in stored:
            stored["session"] = Session(workspace)
        show_frame(stored["session"])

    ui.run(
        show_root,
        host=HOST,
        port=port,
        title="dem-jax",
        favicon="⚖️",
        show=False,
        reload=False,
        language="en-US",
        show_welcome_message=False,
        tailwind=False,
        binding_refresh_interval=None,
        reconnect_timeout=30.0,
        timeout_graceful_shutdown=1,  # s, for tabs that are open
    )


def add_routes(workspace: Workspace) -> None:
    """Add the routes of styles, views and files."""
    app.add_static_files("/assets", STATIC)
    head = '<link rel="stylesheet" href="/assets/app.css"><script src="/assets/app.js"></script>'
    ui.add_head_html(head, shared=True)

    @app.get("/view/{key}")
    def _view(key: str) -> Response:
        text = workspace.find_page(key)
        return PlainTextResponse("This view is gone.", 404) if text is None else HTMLResponse(text)

    @app.get("/play/{name}")
    async def _play(name: str, member: int | None = None) -> Response:
        script = (STATIC / "player.js").read_text(encoding="utf-8")
        try:
            path = workspace.folder.find_path(name)
            return HTMLResponse(
                await workspace.helper.ask(facts.write_run_player, str(path), member, script)
            )
        except RecordError as error:
            words = f'<!DOCTYPE html><html lang="en"><title>No view</title><p>{html.escape(str(error))}</p></html>'
            return HTMLResponse(words)

    @app.get("/files/{name}")
    def _file(name: str, inline: bool = False) -> Response:
        try:
            path = workspace.folder.find_path(name)
        except RecordError as error:
            return PlainTextResponse(str(error), 404)
        if not path.is_file():
            return PlainTextResponse("There is no such file.", 404)
        is_picture = inline and path.suffix in (".png", ".gif")
        return FileResponse(path, filename=None if is_picture else path.name)
