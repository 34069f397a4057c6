"""The page on a run: it holds its numbers and poses, loads nothing, and plays in a browser where
there is one.
"""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from importlib.machinery import ModuleSpec
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from dem_jax.errors import RecordError
from dem_jax.visualization import web_viewer
from dem_jax.visualization.fit_file import read_fit
from dem_jax.visualization.report_page import NamedRun, compose_sheets, write_report
from dem_jax.visualization.run_figure import draw_run_figure
from tests.dem_jax.stored import PIECES, SCENE, stored

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


def page_of(names, *runs):
    return write_report(names, runs, "page.html").read_text()


def words(page):
    """What a person reads: the page without scripts, pictures and tags."""
    body = re.sub(r"<script.*?</script>|<style.*?</style>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", body))


def views(page):
    return json.loads(re.search(r'id="views">(.*?)</script>', page, re.DOTALL)[1])


def floats(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_the_page_says_what_happened_in_words_and_units():
    said = words(page_of(["drop"], stored()))
    for expected in (
        "1 × tube", "1 × sphere", "⌀ 20 mm", "300 kg/m³, E = 100 MPa, ε = 0.1, μ = 0.7 between pieces, 0.3 on walls",
        "peak force 2 kg", "time of the peak 21 ms", "settled mass at the end 3 g", "force at the end 3 g",
        "time to rest 80", "NSF = 0.01", "10 times as high", "0.1 ms 2 kg", "1 ms 1.8 kg", "time step 5 µs", "sample time 100 µs",
        "dem_jax 0.1.0",
    ):  # fmt: skip
        assert expected in said, expected
    assert "nan" not in said


def test_the_page_loads_nothing_and_is_small_enough_to_send():
    page = page_of(["drop"], stored())
    assert "default-src 'none'" in page and len(page) < 2e6
    assert set(re.findall(r'\b(?:src|href)="([^"]{5})', page)) == {"data:"}
    assert not re.search(r"@import|url\(|<link|<iframe", page)


def test_the_view_has_the_stored_poses_and_the_real_shapes():
    run = stored()
    ((_, view),) = (each.values() for each in views(page_of(["drop"], run)))
    np.testing.assert_allclose(
        floats(view["position"]).reshape(20, 2, 3), run.pieces.position, atol=1e-7
    )
    np.testing.assert_allclose(
        floats(view["orientation"]).reshape(20, 2, 4), run.pieces.orientation, atol=1e-6
    )
    assert view["time"] == run.pieces.time.tolist() and view["shape"] == [0, 1]
    tube, ball = (floats(shape["triangles"]).reshape(-1, 3, 3) for shape in view["shapes"])
    assert len(tube) == 2 * 4 * 8 and [shape["smooth"] for shape in view["shapes"]] == [False, True]
    radius = np.hypot(tube[..., 0], tube[..., 1])
    round_one = np.sqrt(np.pi / (2.0 * np.sqrt(2.0)))  # an octagon of the area of a circle of
    # radius 1 has this one
    np.testing.assert_allclose(
        np.unique(np.round(1e3 * radius, 3)), np.round([6.0 * round_one, 10.0 * round_one], 3)
    )
    np.testing.assert_allclose(np.linalg.norm(ball, axis=-1), 0.01, rtol=1e-5)
    (plate,) = (floats(wall["triangles"]).reshape(-1, 3) for wall in view["walls"])
    assert plate[:, 2].max() == 0.0 and len(floats(view["wall_pose"])) == 7


def test_poses_are_thinned_to_keep_the_page_small(monkeypatch):
    monkeypatch.setattr(web_viewer, "MOST_BYTES", 10 * 2 * 7 * 4 * 4 // 3 + 1)
    view = web_viewer.build_view_data(stored())
    assert view["time"] == stored().pieces.time[::2].tolist()


def test_a_run_without_frames_gets_a_page_that_says_so():
    page = page_of(["drop"], stored(frames=0))
    assert "No poses were stored of drop: set run.frame_interval" in words(page)
    assert (
        views(page) == [] and "canvas id" not in page and "THREE" not in page.split("<script>")[1]
    )


def test_several_are_overlaid_with_their_differences_in_numbers():
    soft = stored((2.0, 2.2, 2.4, 2.1, 2.3))
    hard = stored(
        (3.0, 3.2, 3.4, 3.1, 3.3), scene=SCENE.replace(material={"numerical_softening": 0.1})
    )
    page = page_of(["soft", "hard"], soft, hard)
    said = words(page)
    assert "2.2 kg (median; 5 to 95 %: 2.02 to 2.38 kg)" in said
    assert (
        "peak force: hard 3.2 kg, soft 2.2 kg: +1 kg (+45.5 %)" in said
        and "hard against soft: beyond chance" in said
    )
    assert "soft: E of the pieces" in said and "hard: E of the pieces" in said
    assert [each["name"] for each in views(page)] == ["soft", "hard"]


def test_names_are_written_as_text():
    page = page_of(["<b>&"], stored())
    assert (
        "<b>" not in page.split("<script")[0]
        and "&lt;b&gt;&amp;" in page
        and views(page)[0]["name"] == "<b>&"
    )


def test_what_cannot_be_is_said_in_one_line():
    with pytest.raises(RecordError, match=r"page\.txt must end in one of: \.html, \.pdf"):
        write_report(["a"], [stored()], "page.txt")
    with pytest.raises(RecordError, match="group = 'lf' is not in this run"):
        write_report(["a"], [stored()], "page.html", group="lf")
    with pytest.raises(RecordError, match="cannot be written: No such file"):
        write_report(["a"], [stored()], "nowhere/page.html")


@pytest.mark.parametrize("page", ["<script>other()</script>", None], ids=["other", "none"])
def test_a_trimesh_whose_viewer_is_another_is_refused(monkeypatch, tmp_path, page):
    templates = tmp_path / "trimesh" / "resources" / "templates"
    templates.mkdir(parents=True)
    if page is not None:
        with ZipFile(templates / "viewer.zip", "w") as packed:
            packed.writestr("viewer.html.template", page)
    installed = ModuleSpec("trimesh", None, origin=str(tmp_path / "trimesh" / "__init__.py"))
    monkeypatch.setattr("dem_jax.visualization.web_viewer.find_spec", lambda name: installed)
    with pytest.raises(RecordError, match=r"trimesh has no three\.js that a report can use"):
        write_report(["a"], [stored()], "page.html")


FIT = {
    "dt_impact": (2e-3, 1.8e-3, 2.1e-3), "gamma_low": (0.02, 0.01, 0.03), "gamma_high": (0.04, 0.03, 0.05),
    "h_mean": (0.2, 0.19, 0.21),
}  # fmt: skip


def fit_file():
    rows = {
        name: dict(zip(("value", "low", "high"), row, strict=True)) for name, row in FIT.items()
    }
    Path("fit.json").write_text(
        json.dumps(
            {"parameters": rows, "statements": ["heaps: the model <does not> describe them"]}
        )
    )
    return read_fit("fit.json")


def test_a_fitted_model_is_shown_with_its_intervals():
    page = write_report(["drop"], [stored()], "page.html", fit=fit_file()).read_text()
    said = words(page)
    assert (
        "length of an impact, Δt_impact 2000 µs 1800 to 2100 µs" in said
        and "h_mean 200 mm 190 to 210 mm" in said
    )
    assert "heaps: the model &lt;does not&gt; describe them" in said and page.count("<img") == 2
    Path("fit.png").write_bytes(b"picture")
    page = write_report(["drop"], [stored()], "page.html", fit=read_fit("fit.json")).read_text()
    assert page.count("<img") == 3 and base64.b64encode(b"picture").decode() in page
    for text, expected in (
        ("{", "not a file of `calibrate fit`"),
        ('{"parameters": {}}', "KeyError"),
    ):
        Path("fit.json").write_text(text)
        with pytest.raises(RecordError, match=expected):
            read_fit("fit.json")


def test_a_narrow_screen_gets_a_figure_of_its_own():
    page = page_of(["drop"], stored())
    assert [page.count(f'<div class="figure {kind}"><img') for kind in ("wide", "narrow")] == [1, 1]
    assert "white-space: nowrap" not in re.search(r"caption {.*}", page)[0], (
        "a caption that does not wrap widens the page"
    )
    figure = draw_run_figure(stored(), narrow=True)
    panels = {axes.get_position().bounds: axes for axes in figure.axes}
    assert figure.get_figwidth() < 5 and len({left for left, *_ in panels}) == 1, "one column"
    assert all(axes.get_ylabel() for axes in figure.axes), "each panel has its labels"


def test_the_same_on_paper():
    """Words of the page are on the sheets, and the PDF has sheets of them."""
    sheets = compose_sheets([NamedRun("drop", stored())], fit=fit_file())
    heads = [sheet.head for sheet in sheets]
    assert (
        heads[:3] == ["Product impact of drop", "The force", "The drop: drop"]
        and "The Product Model, fitted" in heads
    )
    rows = [
        row
        for sheet in sheets
        for words in sheet.words
        if not isinstance(words, str)
        for row in words
    ]
    for row in (
        ["peak force", "2 kg"],
        ["time to rest", "80"],
        ["1 ms", "1.8 kg"],
        ["time step", "5 µs"],
    ):
        assert any(known[0] == row[0] and known[1].startswith(row[1]) for known in rows), row
    data = write_report(["drop"], [stored()], "page.pdf", fit=fit_file()).read_bytes()
    assert (
        data.startswith(b"%PDF") and data.count(b"/Type /Page ") + data.count(b"/Type /Page\n") >= 2
    )


def opened(page, place, budget):
    """The page as a browser leaves it after so many ms of its own time, and what it said."""
    flags = [
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        f"--virtual-time-budget={budget}",
    ]
    folder = [f"--user-data-dir={Path.cwd() / 'browser'}", "--enable-logging=stderr", "--dump-dom"]
    done = subprocess.run(
        [BROWSER, "--headless", *flags, *folder, page.resolve().as_uri() + place],
        capture_output=True,
        text=True,
        timeout=60,
    )
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return (
        int(re.search(r'<canvas id="drop"[^>]*data-frame="(\d+)"', done.stdout)[1]),
        done.stdout,
        said,
    )


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium")
def test_it_opens_and_plays_to_its_end_in_a_browser_without_an_error():
    page = write_report(["drop"], [stored()], "page.html")
    frame, _, said = opened(page, "#t=0.0474", 500)
    assert frame == 10 and said == [], "90 ms in 20 frames: one each 4.74 ms"
    # pictures come at once
    ticks = "<script>requestAnimationFrame = (f) => setTimeout(() => f(performance.now()), 200);</script>"
    page.write_text(page.read_text().replace("<body>", f"<body>{ticks}"))
    frame, left, said = opened(page, "#play", 12000)
    assert frame == 19 and ">Play<" in left and said == [], "it stops at its end"


def test_the_pieces_of_the_made_up_run_are_those_of_its_scene():
    assert len(PIECES) == stored().header.piece_count


def test_a_run_that_ended_before_all_was_settled_is_said_to_have():
    run = stored()
    part = replace(
        run, series=run.series | {"settled_mass": {"plate": run.settled_mass["plate"] / 2.0}}
    )
    assert "When drop ended, 1.5 g of 2.463 g had settled." in words(page_of(["drop"], part))
    assert "drop: 1 of 2 pieces not at rest at the end." in words(page_of(["drop"], part))
    assert "time to rest &gt; 279.9 ms: 1 of 2 pieces not at rest" in words(page_of(["drop"], part))
    assert "had settled" not in words(page_of(["drop"], run))
