"""Page 5: the scale's reading, the Product Model, and files to take along."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from nicegui import ui

from dem_jax.app import facts
from dem_jax.app.jobs import Job
from dem_jax.app.pages import parts
from dem_jax.app.session import Session
from dem_jax.errors import RecordError

FILTERS = {
    "average:0.1": "Mean over 0.1 s",
    "average:0.05": "Mean over 0.05 s",
    "bessel:4:8": "Bessel, 4th order, 8 Hz",
    "fir:201:10": "FIR, 201 taps, 10 Hz",
    "growing:0.05": "Growing window from 0.05 s",
    "none": "No filter",
}


LEAST_DROPS = 10  # of which an estimator learns


class Download(NamedTuple):
    """A file that a command makes of results. ending: of its name. needs_fit: whether it is made of
    a fitted model.
    """

    label: str
    text: str
    program: str
    verb: str
    ending: str
    needs_fit: bool = False


DOWNLOADS = (
    Download(
        "Report", "HTML page to send: numbers, 3-D view, force", "dem-jax", "report", "-report.html"
    ),
    Download("Report as PDF", "The same for print", "dem-jax", "report", "-report.pdf"),
    Download("Spreadsheet", "XLSX with all series", "dem-jax", "export", ".xlsx"),
    Download("Animation", "GIF of the drop", "dem-jax", "export", ".gif"),
    Download("3-D model", "glTF for slides and Blender", "dem-jax", "export", ".glb"),
    Download(
        "FMU", "Fitted model for Simulink and other tools", "product-model", "fmu", ".fmu", True
    ),
    Download("C source", "Fitted model as C99, zipped", "product-model", "c", "-c.zip", True),
)


def make_commands(download: Download, name: str) -> list[str]:
    """The command that makes a download of the results of a name."""
    stem = Path(name).stem
    if not download.needs_fit:
        return [download.program, download.verb, name, "--out", f"{stem}{download.ending}"]
    fit = ["--fit", f"{stem}-fit.json"]
    if download.verb == "fmu":
        return ["product-model", "fmu", *fit, f"{stem}.fmu", "--overwrite"]
    return ["product-model", "c", *fit, "--out", f"{stem}-c", "--overwrite"]


async def show_model(session: Session) -> None:
    """The page."""
    parts.show_title(
        "Weigh and model",
        "See when the scale knows the weight, fit the Product Model, take files along.",
    )
    names = session.folder.list_results()
    if not names:
        ui.label("Nothing has been dropped in this folder yet.").classes("lead")
        return
    if session.shown not in names:
        session.shown = names[0]

    def choose(name: str) -> None:
        session.shown = name
        ui.navigate.to("/model")

    box = ui.select(names, value=session.shown, label="Result", on_change=lambda e: choose(e.value))
    box.props("outlined dense").classes("wide-field")
    try:
        path = str(session.folder.find_path(session.shown))
        found = await session.workspace.helper.ask(facts.describe_run, path, None)
    except RecordError as error:
        parts.show_error(str(error))
        return
    has_cell = "weigh_bucket.load_cell" in " ".join(found.settings)
    _show_weigh(session, has_cell, found.run_count)
    fit = ui.element("div")
    files = ui.element("div")

    def show_files() -> None:
        files.clear()
        with files:
            _show_downloads(session)

    with fit:
        _show_fit(session, found.run_count, show_files)
    show_files()


def _show_weigh(session: Session, has_cell: bool, count: int) -> None:
    """The reading of the scale through filters and an estimator."""
    with ui.element("section").classes("panel").props('aria-label="Weigh"'):
        parts.show_heading("The scale's reading")
        chosen = ui.select(
            FILTERS, multiple=True, value=["average:0.1", "bessel:4:8"], label="Filters"
        )
        chosen.props("outlined use-chips").classes("wide-field")
        weigher = ui.select(
            ["", *session.folder.list_files(".json", "weigher")], value="", label="Estimator"
        )
        weigher.props("outlined dense").classes("field").props["hint"] = (
            "Knows the weight sooner than a filter; learned from drops."
        )
        _show_learning(session, has_cell, count, weigher)
        with ui.element("div"):
            cell = ui.switch("Put a typical load cell under the bucket", value=False)
        cell.set_visibility(not has_cell)
        start = ui.button("Weigh", icon="scale").props("no-caps unelevated")
        command, result = ui.element("div"), ui.element("div").props("aria-live=polite")

        def make_argv() -> list[str]:
            argv = ["dem-jax", "weigh", session.shown]
            for text in chosen.value or []:
                argv += ["--filter", text]
            argv += ["--weigher", weigher.value] if weigher.value else []
            argv += ["--cell", "typical"] if cell.value and not has_cell else []
            return [*argv, "--out", f"{Path(session.shown).stem}-weigh.png"]

        def write_command() -> None:
            command.clear()
            with command:
                parts.show_command([make_argv()], "The command of this reading")

        async def finish(job: Job) -> None:
            result.clear()
            with result:
                parts.show_figure(
                    f"{Path(job.argv[2]).stem}-weigh.png",
                    "Readings of the scale and their error",
                    job,
                )

        follow = parts.show_job(session, "weigh", finish)
        for box in (chosen, weigher, cell):
            box.on_value_change(write_command)
        start.on_click(lambda: follow(session.workspace.runner.enter(make_argv())))
        write_command()


def _show_learning(session: Session, has_cell: bool, count: int, weigher: ui.select) -> None:
    """An estimator that is learned from the drops that are shown."""
    if count < LEAST_DROPS or not has_cell:
        words = f"An estimator is learned from {LEAST_DROPS} or more drops into a bucket on a load cell (page 2)."
        ui.label(words).classes("small")
        return
    target = f"weigher-{Path(session.shown).stem}.json"
    argv = ["calibrate", "weigher", session.shown, "--noise", "typical", "--out", target]
    argv.append("--overwrite")
    start = ui.button("Learn an estimator from these drops", icon="school").props("no-caps outline")
    said = ui.element("div").props("aria-live=polite")

    async def finish(job: Job) -> None:
        weigher.set_options(["", *session.folder.list_files(".json", "weigher")], value=target)
        said.clear()
        with said:
            parts.show_text("pre", "\n".join(job.lines)).props("tabindex=0")
            parts.show_command([job.argv], "The command of this estimator")

    follow = parts.show_job(session, "weigher", finish)
    start.on_click(lambda: follow(session.workspace.runner.enter(argv)))


def _show_fit(session: Session, count: int, show_files: Callable[[], None]) -> None:
    """The Product Model of several drops, with its judgement. show_files: called when it is there."""
    with ui.element("section").classes("panel").props('aria-label="Product Model"'):
        parts.show_heading("Product Model")
        if count < 2:
            ui.label(
                "A fit needs several drops: compute 16 or 64, and choose that result above."
            ).classes("lead")
            return
        stem = Path(session.shown).stem
        with ui.element("div"):
            forced = ui.switch("Fit even if the traces look unusual", value=False)
        start = ui.button("Fit the model", icon="insights").props("no-caps unelevated")
        command = ui.element("div")
        result = ui.element("div").props("aria-live=polite")

        def make_argv() -> list[str]:
            argv = ["calibrate", "fit", session.shown, "--out", f"{stem}-fit.json", "--overwrite"]
            return [*argv, "--force"] if forced.value else argv

        def write_command() -> None:
            command.clear()
            with command:
                parts.show_command([make_argv()], "The command of this fit")

        async def finish(job: Job) -> None:
            result.clear()
            with result:
                parts.show_figure(f"{stem}-fit.png", "Traces and the fitted model", job)
            show_files()

        follow = parts.show_job(session, "fit", finish)
        forced.on_value_change(write_command)
        start.on_click(lambda: follow(session.workspace.runner.enter(make_argv())))
        write_command()


def _show_downloads(session: Session) -> None:
    """Files that others can use."""
    with ui.element("section").classes("panel").props('aria-label="Downloads"'):
        parts.show_heading("Take along")
        name, stem = session.shown, Path(session.shown).stem
        has_fit = session.folder.find_path(f"{stem}-fit.json").is_file()
        command = ui.element("div")

        async def finish(job: Job) -> None:
            target = session.opened_jobs["download"]
            if target.endswith("-c.zip"):
                session.folder.zip_folder(target.removesuffix(".zip"), target)
            ui.download(f"/files/{target}")

        def begin(download: Download) -> None:
            argv = make_commands(download, name)
            session.folder.find_path(f"{stem}{download.ending}").unlink(missing_ok=True)
            session.opened_jobs["download"] = f"{stem}{download.ending}"
            command.clear()
            with command:
                parts.show_command([argv], "The command of this file")
            follow(session.workspace.runner.enter(argv))

        with ui.element("div").classes("downloads"):
            for download in DOWNLOADS:
                with ui.element("div"):
                    box = ui.button(
                        download.label, icon="download", on_click=lambda _, d=download: begin(d)
                    )
                    box.props("outline no-caps").set_enabled(has_fit or not download.needs_fit)
                    ui.label(
                        download.text + ("" if has_fit or not download.needs_fit else "; fit first")
                    ).classes("small")
            _show_own_files(session, stem)
        follow = parts.show_job(session, "download", finish)


def _show_own_files(session: Session, stem: str) -> None:
    """The files behind a result: the result, and the scene with the parts that it names."""

    def take_scene() -> None:
        names = session.folder.list_parts(f"{stem}.toml")
        if len(names) > 1:
            session.folder.zip_files(names, f"{stem}-scene.zip")
        ui.download(f"/files/{stem}-scene.zip" if len(names) > 1 else f"/files/{stem}.toml")

    rows = (
        (".h5", "Result file", "HDF5", lambda: ui.download(f"/files/{stem}.h5")),
        (".toml", "Scene file", "TOML; zipped with STL files of your own", take_scene),
    )
    for ending, label, text, take in rows:
        if session.folder.find_path(f"{stem}{ending}").is_file():
            with ui.element("div"):
                box = ui.button(label, icon="download", on_click=take)
                box.props("outline no-caps")
                ui.label(text).classes("small")
