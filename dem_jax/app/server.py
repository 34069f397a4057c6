"""The server: routes of the pages, of views and of files, behind the guard."""

import asyncio
import json
import logging
import signal
import socket
import sys
import zlib
from typing import Any

import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse
from nicegui import app, ui

from dem_jax.app import facts
from dem_jax.app.access import AccessGuard
from dem_jax.app.pages.frame import show_frame
from dem_jax.app.session import STATIC, Session, Workspace
from dem_jax.errors import RecordError


def serve(workspace: Workspace, listening: socket.socket, token: str) -> None:
    """Serve the app until it is interrupted.

    listening: takes its connections. token: of its address.
    """
    outer = FastAPI(openapi_url=None)
    outer.add_middleware(AccessGuard, token=token, port=listening.getsockname()[1])
    # A bar over the page while files load has no name that a screen reader could tell.
    app.config.quasar_config["loadingBar"]["skipHijack"] = True
    add_routes(workspace)
    app.on_shutdown(workspace.close)

    async def show_root() -> None:
        await ui.context.client.connected(timeout=60.0)
        stored: Any = app.storage.tab
        if "session" not in stored:
            stored["session"] = Session(workspace)
        show_frame(stored["session"])

    ui.run_with(
        outer,
        root=show_root,
        title="dem-jax",
        favicon="⚖️",
        language="en-US",
        show_welcome_message=False,
        tailwind=False,
        binding_refresh_interval=None,
        reconnect_timeout=30.0,
    )
    logging.getLogger("uvicorn.error").addFilter(is_worth_saying)
    config = uvicorn.Config(
        outer,
        log_level="warning",
        ws="wsproto",
        timeout_graceful_shutdown=1,  # s, for tabs that are open
    )
    for number in (signal.SIGINT, signal.SIGTERM):  # after the server has ended
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    uvicorn.Server(config).run([listening])


def is_worth_saying(record: logging.LogRecord) -> bool:
    """Whether a line belongs into the log: not that tabs were open when the server ended."""
    error = record.exc_info[1] if record.exc_info else None
    is_ending = isinstance(error, asyncio.CancelledError) or "graceful shutdown" in record.msg
    return not is_ending


def add_routes(workspace: Workspace) -> None:
    """Add the routes of styles, views and files."""
    app.add_static_files("/assets", STATIC)
    head = '<link rel="stylesheet" href="/assets/app.css"><script src="/assets/app.js"></script>'
    ui.add_head_html(head, shared=True)

    @app.get("/player")
    async def _player(request: Request) -> Response:
        text = await workspace.write_player()
        headers = {"etag": f'W/"{zlib.crc32(text.encode()):x}"', "cache-control": "no-cache"}
        if request.headers.get("if-none-match") == headers["etag"]:
            return Response(status_code=304, headers=headers)
        return HTMLResponse(text, headers=headers)

    @app.get("/preview/{key}")
    def _preview(key: str) -> Response:
        text = workspace.find_view(key)
        if text is None:
            return PlainTextResponse("This view is gone.", 404)
        return Response(text, media_type="application/json")

    @app.get("/poses/{name}")
    async def _poses(name: str, member: int = 0) -> Response:
        try:
            path, grows = workspace.folder.find_path(name), workspace.runner.is_writing(name)
            text = await workspace.helper.ask(facts.write_view, str(path), member, grows)
        except RecordError as error:
            text = json.dumps({"more": False, "words": str(error)})
        return Response(text, 200 if text else 204, media_type="application/json")

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
