"""Start of the app: it listens and its processes begin before the server itself is imported."""

import secrets
import socket
import sys
import threading
import webbrowser
from importlib.util import find_spec

from dem_jax.app.folder import Folder
from dem_jax.app.jobs import JobRunner
from dem_jax.app.launch import import_ahead
from dem_jax.errors import RecordError

HOST = "127.0.0.1"
BACKLOG = 128  # connections that wait until the server takes them


def start_app(folder: Folder, port: int, opens_browser: bool) -> None:
    """Serve the app until it is interrupted.

    Args:
        folder: of all scenes and results.
        port: of this machine; 0: a free one.
        opens_browser: whether the address is opened, beside being printed.

    Raises:
        RecordError: the port is taken, or the extra is missing.
    """
    if find_spec("nicegui") is None:
        raise RecordError("app: NiceGUI is missing; allowed: pip install 'product-impact[app]'")
    with listen(port) as listening:
        import_ahead()
        from dem_jax.app.session import Workspace

        workspace = Workspace(folder, JobRunner(folder.root))
        starting = threading.Thread(target=workspace.start)  # it waits for the imports
        starting.start()
        token = secrets.token_urlsafe(24)
        address = f"http://{HOST}:{listening.getsockname()[1]}/?token={token}"
        print(f"dem-jax app of {folder.root}\n{address}\nCtrl+C ends it.", flush=True)
        if opens_browser:
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        try:
            from dem_jax.app.server import serve

            starting.join()
            serve(workspace, listening, token)
        finally:
            starting.join()
            workspace.end()


def listen(wanted: int) -> socket.socket:
    """A socket that takes connections of this machine; they wait until the server answers.

    wanted: port; 0: a free one. Raises RecordError for one that is taken.
    """
    listening = socket.socket()
    if sys.platform != "win32":
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, wanted))
        listening.listen(BACKLOG)
    except (OSError, OverflowError) as error:
        listening.close()
        raise RecordError(
            f"--port {wanted}: it is taken; allowed: another port, or 0 for a free one"
        ) from error
    return listening
