"""A person who only clicks, in a browser: own parts, a drop, 16 from 5 cm less, comparison."""

import os
import re
import shutil
import subprocess
import sys
import time

import pytest
import trimesh

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium")
ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
PATIENCE = 120_000  # ms, of a drop on a busy machine
PAGES = ("Product", "Bucket and release", "Drop", "Compare", "Weigh and model")
WIDTHS = (390, 1280)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """The app in an empty folder: (folder, address)."""
    folder = tmp_path_factory.mktemp("app")
    command = [sys.executable, "-m", "dem_jax", "app", str(folder), "--no-browser"]
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=own)
    lines = [process.stdout.readline() for _ in range(2)]
    yield folder, lines[1].strip()
    process.terminate()
    try:
        process.wait(20)
    finally:
        process.kill()


@pytest.fixture(scope="module")
def page(server):
    """A tab of the app, with ``said``: errors of its console."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=BROWSER, args=ARGUMENTS)
        tab = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
        tab.said = []
        tab.on(
            "console", lambda m: tab.said.append(m.text) if m.type in ("error", "warning") else None
        )
        tab.on("pageerror", lambda error: tab.said.append(str(error)))
        tab.set_default_timeout(30_000)
        tab.goto(server[1])
        yield tab
        browser.close()


def write_parts(folder):
    """An STL of a nugget and one of a tray, both in mm."""
    nugget = trimesh.creation.box((44.0, 34.0, 16.0))
    nugget.export(folder / "nugget.stl")
    tray = trimesh.creation.box((180.0, 160.0, 90.0))
    tray.update_faces(tray.face_normals[:, 2] < 0.5)
    tray.invert()
    tray.export(folder / "tray.stl")


def step(page, title):
    page.get_by_role("navigation").get_by_role("link", name=title).click()
    page.get_by_role("heading", name=title, level=1).wait_for()


def fill(page, label, value):
    box = page.get_by_label(label)
    box.fill(str(value))
    box.press("Tab")


def test_the_story_by_clicks_alone(server, page, tmp_path):
    folder = server[0]
    write_parts(tmp_path)

    page.locator("input[type=file]").set_input_files(tmp_path / "nugget.stl")
    page.get_by_text("44 × 34 × 16 mm").wait_for()
    fill(page, "Weight of a piece (g)", 18)
    page.get_by_role("button", name="Use this part").click()
    page.get_by_text("18 g a piece").wait_for()

    step(page, "Bucket and release")
    page.get_by_text("Your own weigh bucket from an STL file").click()
    page.locator("input[type=file]").set_input_files(tmp_path / "tray.stl")
    page.get_by_role("button", name="Use this bucket").click()
    page.get_by_text("Your own: tray").wait_for()
    fill(page, "Drop height (mm)", -5)
    page.get_by_role("alert").get_by_text("allowed: above 0 mm").wait_for()
    fill(page, "Drop height (mm)", 250)
    fill(page, "Target weight (g)", 100)
    fill(page, "Duration (s)", 0.4)
    page.get_by_text("100 g asked, 6 pieces = 108 g").wait_for()
    page.frame_locator("iframe").locator("canvas[data-frame]").wait_for()

    step(page, "Drop")
    page.get_by_role("button", name="Drop", exact=True).click()
    page.frame_locator("iframe").locator("canvas[data-frame]").wait_for(timeout=PATIENCE)
    page.get_by_role("button", name="Jump to the peak").click()
    frame = page.frame_locator("iframe").locator("canvas")
    page.wait_for_timeout(300)
    assert int(frame.get_attribute("data-frame")) > 0
    shown = page.locator(".command pre").first.inner_text()
    assert shown.startswith("dem-jax run nugget-2.toml"), "the command of the next drop"

    step(page, "Bucket and release")
    fill(page, "Drop height (mm)", 200)
    page.get_by_text("100 g asked").wait_for()
    step(page, "Drop")
    page.get_by_role("button", name="16 drops").click()
    page.get_by_role("button", name="Drop", exact=True).click()
    page.get_by_text("Medians and bands").wait_for(timeout=PATIENCE)

    step(page, "Compare")
    page.get_by_role("cell", name="0.25", exact=True).wait_for()
    assert page.get_by_role("row", name="drop.height").count() == 1
    page.get_by_text(re.compile("beyond chance")).last.wait_for()

    step(page, "Weigh and model")
    with page.expect_download(timeout=PATIENCE) as found:
        page.get_by_role("button", name="Report", exact=True).click()
    assert found.value.suggested_filename == "nugget-2-report.html"
    assert sorted(path.name for path in folder.glob("nugget*")) == [
        "nugget-2-report.html",
        "nugget-2.h5",
        "nugget-2.toml",
        "nugget.h5",
        "nugget.toml",
    ]
    assert page.said == []


@pytest.mark.parametrize("width", WIDTHS)
def test_each_page_is_accessible_and_as_wide_as_the_screen(page, width):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page.set_viewport_size({"width": width, "height": 900})
    for title in PAGES:
        step(page, title)
        page.wait_for_timeout(800)
        found = axe.run(page)
        serious = [
            v for v in found.response["violations"] if v["impact"] in ("serious", "critical")
        ]
        said = [(v["id"], [n["html"][:200] for n in v["nodes"][:3]]) for v in serious]
        assert not said, f"{title}, {width} px: {said}"
        assert page.evaluate("document.documentElement.scrollWidth") <= width, title
    assert page.said == []


def test_the_page_answers_while_a_drop_is_computed(page):
    step(page, "Drop")
    page.get_by_role("button", name="One drop").click()
    page.get_by_role("button", name="Drop", exact=True).click()
    page.get_by_role("button", name="Cancel").wait_for()
    times = []
    for _ in range(5):
        started = time.monotonic()
        page.evaluate("fetch('/files/nugget.toml').then((answer) => answer.text())")
        times.append(time.monotonic() - started)
    assert min(times) < 0.1, "s; a busy machine may take longer for some"
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text(re.compile("^cancelled: ")).wait_for()
