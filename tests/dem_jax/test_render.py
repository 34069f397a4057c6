"""Pictures: what hides what, against cast rays; pieces where they are; see-through walls; strips
and animations.
"""

import sys
from importlib.util import find_spec

import matplotlib.image
import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from dem_jax import shapes
from dem_jax.errors import RecordError
from dem_jax.io.run_files import Frames
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import wall_meshes
from dem_jax.visualization.rendering import (
    Camera,
    _clip_loop,
    _frame_bodies,
    _project_points,
    build_render_scene,
    draw_frames,
    painter_order,
    render_frames,
)

STILL = {"plate": (np.eye(3), np.zeros(3))}


def panel(corners, thickness=0.005):
    made = wall_meshes.build_plate(corners, thickness)
    return made.vertices, made.faces


def box_of_walls(x, y, z):
    """Floor and four walls around [-x, x] x [-y, y] x [0, z], facing inward."""
    floor = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)]
    ring = [(floor[k], floor[(k + 1) % 4]) for k in range(4)]
    return [panel(floor)] + [panel([b, a, (*a[:2], z), (*b[:2], z)]) for a, b in ring]


def packed(count=27, seed=0):
    """One frame of pieces of all kinds, turned at random, on a grid on which their bounding spheres
    do not meet.
    """
    rng = np.random.default_rng(seed)
    kinds = [
        shapes.chamfered_cuboid(),
        shapes.cylinder(0.01, 0.04),
        shapes.sphere(0.02),
        shapes.prism(3, 0.02, 0.01),
    ]
    pieces = [kinds[n % 4] for n in range(count)]
    pitch = 2.01 * max(s.bounding_radius for s in kinds)
    place = pitch * (np.array([(n % 3, n // 3 % 3, n // 9) for n in range(count)]) - (1, 1, -0.6))
    orientation = rng.normal(size=(1, count, 4))
    velocity = rng.normal(size=(1, count, 3))
    return (
        Frames(np.zeros(1), place[None], orientation, velocity, 0 * velocity),
        pieces,
        box_of_walls(0.1, 0.1, 0.2),
    )


def falling(count=12):
    """A marshmallow that falls 0.2 m and turns, then rests, above a plate."""
    time = np.linspace(0, 0.22, count)
    position = np.zeros((count, 1, 3))
    position[:, 0, 2] = np.maximum(0.208 - 4.905 * time**2, 0.008)
    velocity = np.zeros((count, 1, 3))
    velocity[:, 0, 2] = np.where(position[:, 0, 2] > 0.008, -9.81 * time, 0)
    orientation = np.stack([np.cos(4 * time), 0 * time, 0 * time, np.sin(4 * time)], -1)[:, None]
    walls = {
        "plate": [panel([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)], 0.05)]
    }
    return (
        Frames(time, position, orientation, velocity, 0 * velocity),
        [shapes.chamfered_cuboid()],
        walls,
    )


def depth_along(ray, eye, body):
    """Distance from the eye at which a ray enters a convex body; infinity if it misses."""
    facing, room = body.normals @ ray, body.offsets - body.normals @ eye
    with np.errstate(divide="ignore"):
        cut = room / facing
    enters, leaves = cut[facing < 0].max(), cut[facing > 0].min()
    return enters if enters <= leaves else np.inf


def stacked():
    """27 marshmallows laid like bricks with gaps of 1 mm, all turned alike: their bounding spheres
    overlap.
    """
    place = np.array([(n % 3, n // 3 % 3, n // 9) for n in range(27)]) - (1, 1, 1)
    turn = np.array([0.9, 0.1, -0.3, 0.2])
    centres = (place * (0.056, 0.024, 0.017)) @ quaternion_to_matrix(turn).T + (0, 0, 0.11)
    orientation = np.tile(turn, (1, 27, 1))
    frames = Frames(
        np.zeros(1), centres[None], orientation, np.ones((1, 27, 3)), np.zeros((1, 27, 3))
    )
    return frames, [shapes.chamfered_cuboid()] * 27, box_of_walls(0.11, 0.11, 0.2)


def made_of_parts():
    """Tubes, one beside the next on a grid, and dumb-bells, turned at random: parts that touch, in
    rings and in rows.
    """
    rng = np.random.default_rng(3)
    blocks = [((0.02, 0.02, 0.02), -0.02), ((0.02, 0.006, 0.006), 0.0), ((0.02, 0.02, 0.02), 0.02)]
    bell = shapes.make_compound(
        [shapes.PlacedShape(shapes.cuboid(size), (x, 0, 0)) for size, x in blocks]
    )
    kinds = [shapes.tube(0.02, 0.014, 0.03, 6), bell]
    pitch = 2.01 * max(s.bounding_radius for s in kinds)
    place = pitch * (np.array([(n % 2, n // 2 % 2, n // 4) for n in range(6)]) - (0.5, 0.5, -0.6))
    frames = Frames(
        np.zeros(1),
        place[None],
        rng.normal(size=(1, 6, 4)),
        np.ones((1, 6, 3)),
        np.zeros((1, 6, 3)),
    )
    return frames, [kinds[n % 2] for n in range(6)], box_of_walls(0.08, 0.08, 0.2)


@pytest.mark.parametrize(
    "camera", [Camera(), Camera(-70, 35, 3), Camera(200, 80, 8), Camera(0, 0, 4)]
)
@pytest.mark.parametrize("arranged", [packed, stacked, made_of_parts])
def test_what_is_drawn_last_is_what_a_ray_from_the_eye_meets_first(camera, arranged):
    frames, pieces, walls = arranged()
    scene = build_render_scene(frames, pieces, {"plate": walls}, lambda t: STILL, camera)
    bodies, _, count = _frame_bodies(scene, 0)
    assert count == 27 and len(bodies) == 32
    view, order = scene.view, painter_order(bodies, scene.view)
    assert sorted(order) == list(range(32))
    rng = np.random.default_rng(1)
    targets = rng.uniform(scene.view.box[0], scene.view.box[1], size=(2000, 3))
    crossed = 0
    for ray in targets - view.eye:
        depth = [depth_along(ray, view.eye, bodies[b]) for b in order]
        met = [k for k, d in enumerate(depth) if np.isfinite(d)]
        crossed += len(met) > 1
        # rank in the order of drawing must fall with depth for all bodies that the ray meets
        assert sorted(met, key=lambda k: -depth[k]) == met
    assert crossed > 500


def test_a_panel_that_is_partly_outside_is_cut_at_the_box():
    square = np.array([(-2.0, 0, 0), (2, 0, 0), (2, 1, 0), (-2, 1, 0)])
    kept = _clip_loop(square, np.array([(-1.0, -1, -1), (1, 0.5, 1)]))
    assert {tuple(p) for p in kept.tolist()} == {(-1, 0, 0), (1, 0, 0), (1, 0.5, 0), (-1, 0.5, 0)}
    assert len(_clip_loop(square + (0, 0, 5), np.array([(-1.0, -1, -1), (1, 1, 1)]))) == 0


def pixels(path):
    return matplotlib.image.imread(path)[..., :3]


def place_on_picture(figure, scene, point, shape):
    """Row and column of the pixel at which a point in space is drawn."""
    x, y = (
        figure.axes[0].transData.transform(_project_points(scene.view, np.asarray(point, float)))
        * 150
        / figure.dpi
    )
    return shape[0] - 1 - round(y), round(x)


def test_pieces_are_drawn_where_they_are_and_in_the_colour_of_their_speed(tmp_path):
    frames, pieces, walls = falling()
    scene = build_render_scene(frames, pieces, walls, lambda t: STILL, Camera())
    for i in (0, 6, 11):
        render_frames(
            frames, pieces, walls, lambda t: STILL, tmp_path / "now.png", at=frames.time[i] + 1e-3
        )
        picture = pixels(tmp_path / "now.png")
        figure = draw_frames(scene, [i])
        figure.draw_without_rendering()
        top = frames.position[i, 0] + (0, 0, 0.008)  # the middle of the upper face, which the
        # camera sees
        row, column = place_on_picture(figure, scene, top, picture.shape)
        red, green, blue = (
            picture[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(axis=0)
        )
        speed = -frames.velocity[i, 0, 2] / np.abs(frames.velocity).max()
        assert red > green > blue  # on the scale from cream to red, and
        assert green == pytest.approx(np.interp(speed, [0, 0.55, 1], [0.93, 0.58, 0.07]), abs=0.12)
        elsewhere = picture[place_on_picture(figure, scene, top + (0, 0.1, 0), picture.shape)]
        assert elsewhere.min() > 0.85  # background or plate


def test_walls_do_not_hide_pieces_and_those_in_front_are_thinner():
    frames, pieces, walls = packed()
    scene = build_render_scene(frames, pieces, {"plate": walls}, lambda t: STILL, Camera())
    (ax,) = [a for a in draw_frames(scene, [0]).axes if a.get_title()]
    (collection,) = [c for c in ax.collections if isinstance(c, PolyCollection)]
    alphas = np.unique(collection.get_facecolor()[:, 3].round(3))
    np.testing.assert_array_equal(alphas, [0.08, 0.25, 1.0])
    assert (collection.get_facecolor()[:, 3] == 1.0).sum() > 27


def test_everything_is_inside_the_picture():
    frames, pieces, walls = falling()
    scene = build_render_scene(frames, pieces, walls, lambda t: STILL, Camera())
    figure = draw_frames(scene, [0, 11])
    for ax in figure.axes[:2]:
        (collection,) = [c for c in ax.collections if isinstance(c, PolyCollection)]
        points = np.concatenate([path.vertices for path in collection.get_paths()])
        assert (points.min(axis=0) > (ax.get_xlim()[0], ax.get_ylim()[0])).all()
        assert (points.max(axis=0) < (ax.get_xlim()[1], ax.get_ylim()[1])).all()
    assert [ax.get_title() for ax in figure.axes[:2]] == ["t = 0.0 ms", "t = 220.0 ms"]
    assert figure.axes[2].get_ylabel() == "speed (m/s)"


def test_the_bar_of_length_is_as_long_as_it_says():
    frames, pieces, walls = falling()
    scene = build_render_scene(frames, pieces, walls, lambda t: STILL, Camera())
    ax = draw_frames(scene, [0]).axes[0]
    (words,) = [text.get_text() for text in ax.texts]
    millimetres = float(words.removesuffix(" mm"))
    drawn = np.ptp(ax.get_lines()[0].get_xdata())
    middle = scene.view.box.mean(axis=0)
    ends = _project_points(
        scene.view, np.stack([middle, middle + 1e-3 * millimetres * scene.view.axes[0]])
    )
    assert drawn == pytest.approx(ends[1, 0] - ends[0, 0], rel=1e-12)


def test_a_strip_shows_its_instants_side_by_side(tmp_path):
    frames, pieces, walls = falling()
    one, three = tmp_path / "one.png", tmp_path / "three.png"
    render_frames(frames, pieces, walls, lambda t: STILL, one)
    render_frames(frames, pieces, walls, lambda t: STILL, three, strip=[0.0, 0.1, 0.2])
    assert pixels(three).shape[1] > 2 * pixels(one).shape[1]
    scene = build_render_scene(frames, pieces, walls, lambda t: STILL, Camera())
    titles = [ax.get_title() for ax in draw_frames(scene, [0, 5, 10], "drop").axes[:3]]
    assert titles == ["drop\nt = 0.0 ms", "drop\nt = 100.0 ms", "drop\nt = 200.0 ms"]


def test_an_animation_has_all_frames_moves_and_loops(tmp_path):
    from PIL import Image

    frames, pieces, walls = falling()
    render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "drop.gif", fps=20)
    with Image.open(tmp_path / "drop.gif") as animation:
        assert (
            animation.n_frames == 12
            and animation.info["loop"] == 0
            and animation.info["duration"] == 50
        )
        heights = []
        for i in range(12):
            animation.seek(i)
            picture = (
                np.asarray(animation.convert("RGB"), float)[60:, : int(0.8 * animation.width)] / 255
            )
            # the piece is not grey
            rows = np.flatnonzero((picture[..., 0] - picture[..., 2] > 0.06).any(axis=1))
            heights.append(rows.mean())
    assert (np.diff(heights)[:10] > 0).all() and heights[-1] > 1.8 * heights[0]


def test_a_video_shows_the_same_pictures(tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    frames, pieces, walls = falling()
    render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "drop.mp4", fps=20)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "drop.mp4"))
    facts = next(reader)
    shown = [
        np.frombuffer(picture, np.uint8).reshape(*facts["size"][::-1], 3) for picture in reader
    ]
    assert len(shown) == 12 and facts["fps"] == 20
    heights = []
    for picture in shown:
        picture = picture[60:, : int(0.8 * picture.shape[1])] / 255
        heights.append(
            np.flatnonzero((picture[..., 0] - picture[..., 2] > 0.06).any(axis=1)).mean()
        )
    assert (np.diff(heights)[:10] > 0).all() and heights[-1] > 1.8 * heights[0]


def test_moving_walls_are_drawn_where_they_are():
    frames, pieces, _ = falling()
    flap = {"flap": [panel([(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)])]}
    quarter = quaternion_to_matrix([np.sqrt(0.5), np.sqrt(0.5), 0, 0])  # about x: y to z

    def pose(t):
        return (
            {"flap": (quarter, np.array([0, 0.05, 0]))}
            if t > 0.1
            else {"flap": (np.eye(3), np.zeros(3))}
        )

    scene = build_render_scene(frames, pieces, flap, pose, Camera())
    before, after = _frame_bodies(scene, 0)[0][-1], _frame_bodies(scene, 11)[0][-1]
    np.testing.assert_allclose(before.vertices[2], (0.1, 0.1, 0), atol=1e-15)
    np.testing.assert_allclose(after.vertices[2], (0.1, 0.05, 0.1), atol=1e-15)
    np.testing.assert_allclose(after.normals[0], (0, -1, 0), atol=1e-15)


def test_pieces_told_apart_by_number_have_colours_of_their_own(tmp_path):
    frames, pieces, walls = packed()
    scene = build_render_scene(
        frames, pieces, {"plate": walls}, lambda t: STILL, Camera(), colour="piece"
    )
    _, paints, _ = _frame_bodies(scene, 0)
    assert len(set(paints[:6])) == 6
    figure = draw_frames(scene, [0])
    assert len(figure.axes) == 1  # no scale of speeds


def test_a_piece_that_is_no_longer_anywhere_is_left_out(tmp_path):
    frames, pieces, walls = packed()
    frames.position[0, 5] = np.nan
    frames.velocity[0, 5] = np.inf
    scene = build_render_scene(frames, pieces, {"plate": walls}, lambda t: STILL, Camera())
    assert (
        _frame_bodies(scene, 0)[2] == 26
        and np.isfinite(scene.view.eye).all()
        and scene.fastest < 10
    )
    render_frames(frames, pieces, {"plate": walls}, lambda t: STILL, tmp_path / "now.png")
    assert (pixels(tmp_path / "now.png").min(axis=-1) < 0.9).mean() > 0.1


def test_what_cannot_be_drawn_is_said_in_one_line(tmp_path, monkeypatch):
    frames, pieces, walls = falling()
    with pytest.raises(
        RecordError, match=r"now\.bmp must end in one of: \.png, \.pdf, \.svg, \.gif, \.mp4"
    ):
        render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "now.bmp")
    with pytest.raises(RecordError, match=r"the run has no frames; set run\.frame_interval"):
        render_frames(None, pieces, walls, lambda t: STILL, tmp_path / "now.png")
    ensemble = Frames(
        frames.time, *(np.stack([getattr(frames, n)] * 2) for n in list(vars(frames))[1:])
    )
    with pytest.raises(RecordError, match="frames of an ensemble; choose one of its runs"):
        render_frames(ensemble, pieces, walls, lambda t: STILL, tmp_path / "now.png")
    for instants in ({"at": 5.0}, {"at": -0.1}, {"strip": [0.0, 5.0]}):
        with pytest.raises(
            RecordError, match=r"no frame was stored at .* s; allowed: 0 to 0\.22 s"
        ):
            render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "now.png", **instants)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "imageio_ffmpeg", None)  # as where it is not installed
        with pytest.raises(
            RecordError,
            match=r"now\.mp4 needs imageio-ffmpeg: pip install 'product-impact\[video\]'",
        ):
            render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "now.mp4")
    with pytest.raises(RecordError, match="colour = 'spin' is unknown"):
        render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "now.png", colour="spin")
    for name in ("now.png", "now.gif", *(["now.mp4"] if find_spec("imageio_ffmpeg") else [])):
        with pytest.raises(RecordError, match="cannot be written: No such file"):
            render_frames(frames, pieces, walls, lambda t: STILL, tmp_path / "nowhere" / name)
