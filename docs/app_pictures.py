"""Pictures of the page "For people who click": the app itself in a browser, in the story of an own nugget and an own
bucket. Needs the extra `app`, chromium and playwright. Run: ``python docs/app_pictures.py [FOLDER]``, an empty folder.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import trimesh
from PIL import Image

DOCS = Path(__file__).parent
PATIENCE = 600_000  # ms
WIDTH, HEIGHT = 1280, 900  # pixels
GIF_SIZE, COLOURS = (860, 605), 96
GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def write_parts(folder: Path) -> None:
    """An STL of a nugget and one of a tray, both in mm."""
    trimesh.creation.box((44.0, 34.0, 16.0)).export(folder / "nugget.stl")
    tray = trimesh.creation.box((180.0, 160.0, 90.0))
    tray.update_faces(tray.face_normals[:, 2] < 0.5)
    tray.invert()
    tray.export(folder / "tray.stl")


class Story:
    """The clicks of the story, and a picture after each. tab: of the browser."""

    def __init__(self, tab: Any) -> None:
        self.tab = tab
        self.frames: list[tuple[Image.Image, int]] = []  # and how long each is shown (ms)

    def go(self, title: str) -> None:
        self.tab.get_by_role("navigation").get_by_role("link", name=title).click()
        self.tab.get_by_role("heading", name=title, level=1).wait_for()
        self.tab.locator(".content[aria-busy=false]").wait_for()

    def fill(self, label: str, value: float) -> None:
        self.tab.get_by_label(label, exact=True).first.fill(str(value))
        self.tab.get_by_label(label, exact=True).first.press("Tab")

    def click(self, name: str) -> None:
        self.tab.get_by_role("button", name=name, exact=True).click()

    def see(self, duration: int, name: str = "") -> None:
        """Keep a picture for the GIF, and as a file of a name."""
        picture = Image.open(io.BytesIO(self.tab.screenshot())).convert("RGB")
        self.frames.append((picture.resize(GIF_SIZE, Image.Resampling.LANCZOS), duration))
        if name:
            picture.quantize(128).save(DOCS / name, optimize=True)

    def save(self) -> None:
        """The GIF of all pictures."""
        pictures = [picture.quantize(COLOURS) for picture, _ in self.frames]
        durations = [duration for _, duration in self.frames]
        pictures[0].save(
            DOCS / "app.gif",
            save_all=True,
            append_images=pictures[1:],
            duration=durations,
            loop=0,
            optimize=True,
        )


def tell_story(story: Story, parts: Path) -> None:
    """Product, bucket, a drop, 16 drops from 5 cm less, and what differs."""
    tab = story.tab
    tab.get_by_text("Library").wait_for()
    tab.locator(".card").nth(8).wait_for()
    story.see(900, "app-product.png")
    tab.locator("input[type=file]").set_input_files(parts / "nugget.stl")
    tab.get_by_text("44 × 34 × 16 mm").wait_for()
    story.fill("Weight of a piece (g)", 18)
    story.see(1200)
    story.click("Use this part")
    tab.get_by_text("18 g a piece").wait_for()
    story.see(1200)
    story.go("Bucket and release")
    tab.get_by_text("Your own weigh bucket from an STL file").click()
    tab.locator("input[type=file]").set_input_files(parts / "tray.stl")
    story.click("Use this bucket")
    tab.get_by_text("Your own: tray").wait_for()
    story.fill("Target weight (g)", 100)
    story.fill("Drop height (mm)", 250)
    tab.get_by_text("6 pieces = 108 g").wait_for()
    tab.wait_for_timeout(3000)
    story.see(1600, "app-bucket.png")
    story.go("Drop")
    story.click("Drop")
    tab.get_by_role("button", name="Jump to the peak").wait_for()
    canvas = tab.frame_locator("iframe").locator("canvas[data-frame]")
    canvas.wait_for()
    tab.evaluate("document.querySelector('.halves').scrollIntoView(); scrollBy(0, -110)")
    chart = tab.get_by_role("slider", name=re.compile("^Force and settled mass"))
    chart.focus()
    tab.keyboard.press("Home")
    for _ in range(24):
        for _ in range(12):
            tab.keyboard.press("ArrowRight")
        tab.wait_for_timeout(400)
        story.see(90)
    story.click("Jump to the peak")
    tab.wait_for_timeout(1500)
    story.see(2000, "app-drop.png")
    story.go("Bucket and release")
    story.fill("Drop height (mm)", 200)
    tab.get_by_text("6 pieces = 108 g").wait_for()
    story.go("Drop")
    story.click("16 drops")
    story.click("Drop")
    tab.get_by_text("Medians and bands", exact=True).wait_for()
    tab.wait_for_timeout(3000)
    story.see(1600)
    story.go("Compare")
    tab.get_by_text(re.compile("beyond chance")).last.wait_for()
    tab.evaluate("scrollBy(0, 210)")
    tab.wait_for_timeout(1500)
    story.see(2500, "app-compare.png")
    story.go("Weigh and model")
    story.click("Weigh")
    tab.get_by_alt_text("Readings of the scale and their error").wait_for()
    tab.wait_for_timeout(1000)
    story.see(2500)


def main() -> None:
    """Write the pictures."""
    from playwright.sync_api import sync_playwright

    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))))
    with tempfile.TemporaryDirectory() as parts, tempfile.TemporaryDirectory() as empty:
        write_parts(Path(parts))
        folder = sys.argv[1] if len(sys.argv) > 1 else empty
        command = [sys.executable, "-m", "dem_jax", "app", folder, "--no-browser"]
        app = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert app.stdout is not None
            address = [app.stdout.readline() for _ in range(2)][1].strip()
            with sync_playwright() as started:
                found = started.chromium.launch(
                    executable_path=browser, args=["--no-sandbox", *GRAPHICS]
                )
                tab = found.new_page(viewport={"width": WIDTH, "height": HEIGHT})
                tab.set_default_timeout(PATIENCE)
                tab.goto(address)
                story = Story(tab)
                tell_story(story, Path(parts))
                story.save()
                found.close()
        finally:
            app.terminate()
            app.wait(30)


if __name__ == "__main__":
    main()
