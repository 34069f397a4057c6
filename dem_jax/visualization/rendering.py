"""Pictures of a scene with its pieces: one instant, a film strip of several, or an animation. Host
side, matplotlib.

A piece is drawn part by part, so that all bodies are convex: the visible faces of one never hide
each other, and the order in which two bodies are drawn depends on which side of a plane between
them the eye is.
"""

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import RecordError
from dem_jax.io.run_data import Frames
from dem_jax.math.loops import loop_normals
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import ConvexPart, Shape, convex_surface_mesh, list_parts
from dem_jax.visualization import animation, scene_geometry
from dem_jax.visualization.run_figure import check_format, save_figure
from dem_jax.visualization.scene_geometry import WallPose

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

WallMeshes = Mapping[str, Sequence[scene_geometry.BodyMesh]]  # by group
Colour = tuple[float, float, float, float]  # r, g, b, a

PICTURES, ANIMATIONS = (".png", ".pdf", ".svg"), (".gif", ".mp4")
PALETTE = ("#f3c6cf", "#fbe9c6", "#cfe3f1", "#d8ecd0", "#e6d7f0", "#f8d5b5")  # of pieces told apart
# by number
WALL_COLOUR, INK = (0.62, 0.69, 0.76), (0.25, 0.22, 0.2)
FULL_HEIGHT = 6.0  # inches, of one picture


@dataclass(frozen=True)
class Camera:
    """Viewpoint of a picture.

    azimuth: (degrees) of the eye about z, from x. elevation: (degrees) of the eye above the
    horizontal. distance: of the eye from the middle of the scene, in radii of the scene.
    """

    azimuth: float = 25.0
    elevation: float = 14.0
    distance: float = 5.0


class ConvexBody(NamedTuple):
    """A convex body: vertices [V, 3] (m), faces, outward normals [F, 3], offsets [F] (m), with or
    without outlines.
    """

    vertices: np.ndarray
    faces: tuple[tuple[int, ...], ...]
    normals: np.ndarray
    offsets: np.ndarray
    outlined: bool


class CameraView(NamedTuple):
    """A camera set up: the box [2, 3] (m) that is shown, the eye [3] (m), and right, up and forward
    in rows [3, 3].
    """

    box: np.ndarray
    eye: np.ndarray
    axes: np.ndarray


def render_frames(
    frames: Frames | None,
    shapes: Sequence[Shape],
    walls: WallMeshes,
    wall_pose: WallPose,
    path: str | Path,
    at: float | None = None,
    strip: int | Sequence[float] | None = None,
    camera: Camera | None = None,
    colour: str = "speed",
    title: str = "",
    fps: float = 25,
    labels: Sequence[str] = (),
) -> Path:
    """Write a picture or an animation of stored poses; the path's suffix selects the kind.

    frames: io.run_data.Frames of a single run. shapes: a Shape for each of the N pieces. walls:
    group -> list of (vertices [V, 3] (m), faces) in the group's rest frame, the first face being
    the surface that the pieces touch; wall_pose: t -> group -> (rotation [3, 3], origin [3] (m)).
    path: .gif and .mp4 are the animation, the first looping, of at most 200 frames at fps per
    second; .png, .pdf, .svg the instant `at` (s; by default the last), or a film strip of the
    instants `strip`: their times (s), or their number, evenly spaced. Each instant shows the stored
    frame nearest to it. colour: "speed" or "piece". title: text before the time. labels: text
    before the time of each instant of a strip. Returns the path. Raises RecordError for another
    format, no frames, an instant before or after them, a file that cannot be written, and for .mp4
    without imageio-ffmpeg.
    """
    path = Path(path)
    check_format(path, PICTURES + ANIMATIONS)
    if frames is None or not np.isfinite(frames.position).all(axis=-1).any():
        raise RecordError(
            f"{path} cannot be drawn: the run has no frames; set run.frame_interval to the time between them (s)"
        )
    if frames.position.ndim != 3:
        raise RecordError(f"{path} cannot be drawn: frames of an ensemble; choose one of its runs")
    scene = build_render_scene(frames, shapes, walls, wall_pose, camera or Camera(), colour)
    if path.suffix.lower() in ANIMATIONS:
        return animation.write_animation(_render_images(scene, title), path, fps)
    return save_figure(
        draw_frames(scene, _find_frame_indices(frames.time, at, strip), title, labels),
        path,
        dpi=150,
    )


class RenderScene(NamedTuple):
    """The bodies to draw, at all times."""

    frames: Frames
    pieces: list[tuple[ConvexBody, ...]]  # the convex parts of each, in its body frame
    plates: list[tuple[str, ConvexBody]]  # (group, panel) in the groups' rest frames
    wall_pose: WallPose
    view: CameraView
    colour: str
    fastest: float  # (m/s) end of the scale of colours


def build_render_scene(
    frames: Frames,
    shapes: Sequence[Shape],
    walls: WallMeshes,
    wall_pose: WallPose,
    camera: Camera,
    colour: str = "speed",
) -> RenderScene:
    """The scene that `draw_frames` draws; arguments as `render_frames`."""
    if colour not in ("speed", "piece"):
        raise RecordError(f'colour = {colour!r} is unknown; allowed: "speed", "piece"')
    known: dict[int, tuple[ConvexBody, ...]] = {}
    for shape in shapes:  # pieces share few shapes
        if id(shape) not in known:
            known[id(shape)] = tuple(_part_body(part) for part in list_parts(shape))
    plates = [(group, _convex_body(*plate)) for group, parts in walls.items() for plate in parts]
    radii = np.array([shape.bounding_radius for shape in shapes])
    speed = np.linalg.norm(frames.velocity, axis=-1)
    fastest = float(np.max(speed, where=np.isfinite(speed), initial=0.0))
    view = _set_up_view(_visible_box(frames, radii, plates, wall_pose), camera)
    return RenderScene(
        frames,
        [known[id(shape)] for shape in shapes],
        plates,
        wall_pose,
        view,
        colour,
        fastest or 1.0,
    )


def draw_frames(
    scene: RenderScene, indices: Sequence[int], title: str = "", labels: Sequence[str] = ()
) -> "Figure":
    """Figure with the stored frames of these indices side by side; above each the title, its label
    and its time.
    """
    figure, axes = _empty_figure(scene, len(indices))
    for i, ax, label in zip(indices, axes, labels or [""] * len(indices), strict=True):
        ax.add_collection(_collect_polygons(scene, i))
        ax.set_title(_frame_caption(scene, i, "\n".join(filter(None, (title, label)))), fontsize=10)
    return figure


def _find_frame_indices(
    times: np.ndarray, at: float | None, strip: int | Sequence[float] | None
) -> list[int]:
    """Indices of the frames nearest to the requested instants. Raises RecordError for one before or
    after them.
    """
    wanted: ArrayLike
    if strip is None:
        wanted = [times[-1] if at is None else at]
    else:
        wanted = np.linspace(times[0], times[-1], strip) if isinstance(strip, int) else strip
    slack = np.diff(times).max(initial=1e-3)  # a run ends less than one frame interval after its
    # last frame
    for t in np.asarray(wanted, float):
        if not times[0] - slack <= t <= times[-1] + slack:
            raise RecordError(
                f"no frame was stored at {t:g} s; allowed: {times[0]:.6g} to {times[-1]:.6g} s"
            )
    return [int(np.argmin(np.abs(times - t))) for t in np.asarray(wanted)]


def _frame_caption(scene: RenderScene, i: int, title: str) -> str:
    time = f"t = {1e3 * scene.frames.time[i]:.1f} ms"
    return f"{title}\n{time}" if title else time


def _render_images(scene: RenderScene, title: str) -> Iterator[np.ndarray]:
    """The frames of an animation, [height, width, 3] uint8, at most 200."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure, (ax,) = _empty_figure(scene, 1)
    figure.set_dpi(100)
    canvas = FigureCanvasAgg(figure)
    count = len(scene.frames.time)
    for i in np.unique(np.linspace(0, count - 1, min(count, 200)).round().astype(int)):
        for old in ax.collections:
            old.remove()
        ax.add_collection(_collect_polygons(scene, i))
        ax.set_title(_frame_caption(scene, i, title), fontsize=10)
        canvas.draw()
        yield np.array(canvas.buffer_rgba())[..., :3]


# --- the figure around the scene ---


def _empty_figure(scene: RenderScene, count: int) -> "tuple[Figure, Sequence[Axes]]":
    """Figure with `count` axes that frame the view, a bar of length and, if colours are speeds,
    their scale.
    """
    from matplotlib.figure import Figure

    low, high = _image_bounds(scene)
    aspect = float(np.clip((high[0] - low[0]) / (high[1] - low[1]), 0.4, 1.8))
    height = FULL_HEIGHT if aspect < 1.2 else FULL_HEIGHT * 1.2 / aspect
    figure = Figure(figsize=(count * height * aspect + 1.1, height + 0.6), layout="constrained")
    axes = figure.subplots(1, count, squeeze=False)[0]
    for ax in axes:
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
        ax.set_axis_off()
    _draw_length_bar(axes[0], scene.view, low, high)
    if scene.colour == "speed":
        _draw_speed_scale(figure, axes, scene.fastest)
    return figure, axes


def _image_bounds(scene: RenderScene) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest point [2], [2] of the image of the pieces at all times and walls at a few,
    with a margin.
    """
    finite, view = np.isfinite(scene.frames.position).all(axis=-1), scene.view
    centres = scene.frames.position[finite]
    radii = np.array(
        [
            max(np.linalg.norm(part.vertices, axis=1).max() for part in piece)
            for piece in scene.pieces
        ]
    )
    radii = np.broadcast_to(radii, finite.shape)[finite]
    flat, size = (
        _project_points(view, centres),
        (radii / ((centres - view.eye) @ view.axes[2]))[:, None],
    )
    low, high = [(flat - size).min(axis=0)], [(flat + size).max(axis=0)]
    for i in (
        np.unique(np.linspace(0, len(scene.frames.time) - 1, 5).astype(int)) if scene.plates else ()
    ):
        points = np.concatenate([path.vertices for path in _collect_polygons(scene, i).get_paths()])
        low.append(points.min(axis=0))
        high.append(points.max(axis=0))
    low, high = np.min(low, axis=0), np.max(high, axis=0)
    return low - 0.04 * (high - low).max(), high + 0.02 * (high - low).max()


def _draw_length_bar(ax: "Axes", view: CameraView, low: np.ndarray, high: np.ndarray) -> None:
    """Draw a bar of round length, scaled as in the middle of the scene."""
    middle = view.box.mean(axis=0)
    per_metre = 1.0 / float((middle - view.eye) @ view.axes[2])
    length = _round_length(0.25 * (high[0] - low[0]) / per_metre)
    left, y = low[0] + 0.03 * (high[0] - low[0]), low[1] + 0.015 * (high[1] - low[1])
    ax.plot(
        [left, left + length * per_metre], [y, y], color=INK, lw=2, solid_capstyle="butt", zorder=5
    )
    ax.text(
        left,
        y + 0.01 * (high[1] - low[1]),
        f"{1e3 * length:g} mm",
        color=INK,
        fontsize=8,
        va="bottom",
        zorder=5,
    )


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length)


def _draw_speed_scale(figure: "Figure", axes: "Sequence[Axes]", fastest: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(0.0, fastest), _speed_colours())
    figure.colorbar(scale, ax=list(axes), label="speed (m/s)", shrink=0.5, aspect=25, pad=0.02)


def _speed_colours() -> "LinearSegmentedColormap":
    """Colours of speeds: cream at rest, over orange, to dark red."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(
        "speed", ["#fdf3e1", "#fdd49e", "#f4935a", "#d7452f", "#8e1220"]
    )


# --- the scene as polygons on the screen ---


def _convex_body(
    vertices: ArrayLike, faces: tuple[tuple[int, ...], ...], outlined: bool = True
) -> ConvexBody:
    vertices = np.asarray(vertices, np.float64)
    normals = loop_normals(vertices, faces)
    return ConvexBody(vertices, faces, normals, (vertices @ normals.T).max(axis=0), outlined)


def _part_body(part: ConvexPart) -> ConvexBody:
    """A convex part of a piece, in the piece's body frame."""
    vertices, faces = convex_surface_mesh(part.shape)
    return _convex_body(vertices + part.centre, faces, outlined=part.shape.radius == 0.0)


def _transform_body(solid: ConvexBody, rotation: np.ndarray, origin: np.ndarray) -> ConvexBody:
    normals = solid.normals @ np.asarray(rotation).T
    vertices = solid.vertices @ np.asarray(rotation).T + origin
    return solid._replace(
        vertices=vertices, normals=normals, offsets=solid.offsets + normals @ origin
    )


def _visible_box(
    frames: Frames, radii: np.ndarray, plates: Sequence[tuple[str, ConvexBody]], wall_pose: WallPose
) -> np.ndarray:
    """Box [2, 3] (m) around all positions of pieces and walls; walls that are far larger are cut
    off.
    """
    finite = np.isfinite(frames.position).all(axis=-1)
    radius = np.broadcast_to(radii, finite.shape)[finite][:, None]
    low, high = (
        (frames.position[finite] - radius).min(axis=0),
        (frames.position[finite] + radius).max(axis=0),
    )
    if not plates:
        return np.stack([low, high])
    reach = 0.25 * np.linalg.norm(high - low)
    found = []
    for t in frames.time[:: max(1, len(frames.time) // 20)]:
        poses = wall_pose(float(t))
        found += [_transform_body(plate, *poses[group]).vertices for group, plate in plates]
    corners = np.concatenate(found)
    low_wall, high_wall = corners.min(axis=0) - 1e-3 * reach, corners.max(axis=0) + 1e-3 * reach
    if np.linalg.norm(high_wall - low_wall) > 10.0 * reach:
        low_wall, high_wall = np.maximum(low_wall, low - reach), np.minimum(high_wall, high + reach)
    return np.stack([np.minimum(low, low_wall), np.maximum(high, high_wall)])


def _set_up_view(box: np.ndarray, camera: Camera) -> CameraView:
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = -np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    eye = box.mean(axis=0) - camera.distance * 0.5 * np.linalg.norm(box[1] - box[0]) * forward
    return CameraView(box, eye, np.stack([right, np.cross(right, forward), forward]))


def _project_points(view: CameraView, points: np.ndarray) -> np.ndarray:
    """Perspective image [..., 2] of points [..., 3]."""
    seen = (points - view.eye) @ view.axes.T
    return seen[..., :2] / seen[..., 2:]


def _collect_polygons(scene: RenderScene, i: int) -> "PolyCollection":
    """PolyCollection of stored frame i, farthest polygons first."""
    from matplotlib.collections import PolyCollection

    bodies, paints, parts = _frame_bodies(scene, i)
    polygons, fills, inks = [], [], []
    for b in painter_order(bodies, scene.view):
        is_wall = b >= parts
        for loop, fill in _visible_faces(scene.view, bodies[b], paints[b]):
            loop = _clip_loop(loop, scene.view.box) if is_wall else loop
            if len(loop) < 3:
                continue
            polygons.append(_project_points(scene.view, loop))
            fills.append(fill)
            inks.append(fill if not bodies[b].outlined else (*INK, 0.35 if is_wall else 0.7))
    width = 0.5 if len(scene.pieces) < 100 else 0.25
    return PolyCollection(
        polygons, facecolors=fills, edgecolors=inks, linewidths=width, joinstyle="round"
    )


def _frame_bodies(scene: RenderScene, i: int) -> tuple[list[ConvexBody], list[Colour], int]:
    """Parts of pieces whose pose at frame i is finite, then panels; the colour (r, g, b, a) of
    each; the number of parts.
    """
    frames = scene.frames
    here = np.flatnonzero(
        np.isfinite(np.c_[frames.position[i], frames.orientation[i]]).all(axis=-1)
    )
    turns = quaternion_to_matrix(frames.orientation[i][here])
    of_piece = zip(here, turns, strict=True)
    parts = [
        _transform_body(part, turn, frames.position[i, n])
        for n, turn in of_piece
        for part in scene.pieces[n]
    ]
    colours = _piece_colours(scene, i)
    poses = scene.wall_pose(float(frames.time[i])) if scene.plates else {}
    plates = [_transform_body(plate, *poses[group]) for group, plate in scene.plates]
    # else before the pieces
    seen = [plate.normals[0] @ scene.view.eye > plate.offsets[0] for plate in plates]
    paints = [colours[n] for n in here for _ in scene.pieces[n]] + [
        (*WALL_COLOUR, 0.25 if s else 0.08) for s in seen
    ]
    return parts + plates, paints, len(parts)


def _piece_colours(scene: RenderScene, i: int) -> list[Colour]:
    from matplotlib.colors import to_rgb

    if scene.colour == "piece":
        return [(*to_rgb(PALETTE[n % len(PALETTE)]), 1.0) for n in range(len(scene.pieces))]
    speed = np.linalg.norm(scene.frames.velocity[i], axis=-1)
    return [tuple(c) for c in _speed_colours()(speed / scene.fastest)]


def _visible_faces(
    view: CameraView, body: ConvexBody, paint: Colour
) -> Iterator[tuple[np.ndarray, Colour]]:
    """(loop [k, 3], colour) of faces that look to the eye, shaded by their angle to a light up on
    the eye's left.
    """
    light = np.array([-0.45, 0.75, -0.5]) @ view.axes
    shade = 0.74 + 0.26 * np.clip(body.normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    for f in np.flatnonzero(body.normals @ view.eye > body.offsets):
        yield body.vertices[list(body.faces[f])], (*(shade[f] * np.array(paint[:3])), paint[3])


def _clip_loop(loop: np.ndarray, box: np.ndarray) -> np.ndarray:
    """The part of a convex loop [k, 3] inside a box [2, 3]."""
    for axis in range(3):
        for side, sign in ((0, 1.0), (1, -1.0)):
            if len(loop) == 0:
                return loop
            inside = sign * (loop[:, axis] - box[side, axis])
            kept = []
            for k in range(len(loop)):
                before, here = inside[k - 1], inside[k]
                if (before < 0.0) != (here < 0.0):
                    kept.append(loop[k - 1] + (loop[k] - loop[k - 1]) * before / (before - here))
                if here >= 0.0:
                    kept.append(loop[k])
            loop = np.array(kept)
    return loop


# --- which body is drawn first ---


def painter_order(bodies: Sequence[ConvexBody], view: CameraView) -> list[int]:
    """Indices of disjoint convex bodies, each after those that it hides; a cycle starts with its
    farthest body.
    """
    centres = np.stack([body.vertices.mean(axis=0) for body in bodies])
    radii = np.array(
        [np.linalg.norm(b.vertices - c, axis=1).max() for b, c in zip(bodies, centres, strict=True)]
    )
    flat = [_project_points(view, body.vertices) for body in bodies]
    low, high = np.stack([f.min(axis=0) for f in flat]), np.stack([f.max(axis=0) for f in flat])
    meet = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(axis=-1)
    after: list[list[int]] = [[] for _ in bodies]  # after[a]: the bodies that must come after a
    waits = np.zeros(len(bodies), int)
    for a, b in zip(*np.nonzero(np.triu(meet, 1)), strict=True):
        first, second = (a, b) if _is_hiding(bodies, centres, radii, b, a, view.eye) else (b, a)
        after[first].append(second)
        waits[second] += 1
    return _topological_order(after, waits, np.linalg.norm(centres - view.eye, axis=1))


def _is_hiding(
    bodies: Sequence[ConvexBody],
    centres: np.ndarray,
    radii: np.ndarray,
    b: int,
    a: int,
    eye: np.ndarray,
) -> bool:
    """Whether b can hide a: the eye is on b's side of the plane that separates them best."""
    between = centres[b] - centres[a]
    distance = np.linalg.norm(between)
    if distance > radii[a] + radii[b]:
        middle = (
            centres[a] + between * (radii[a] + 0.5 * (distance - radii[a] - radii[b])) / distance
        )
        return (eye - middle) @ between > 0.0
    normal_a, level_a, gap_a = _find_best_plane(bodies[a], bodies[b], between)
    normal_b, level_b, gap_b = _find_best_plane(bodies[b], bodies[a], -between)
    return normal_a @ eye > level_a if gap_a >= gap_b else normal_b @ eye <= level_b


def _find_best_plane(
    body: ConvexBody, other: ConvexBody, between: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Face plane of a body (for a ball: the plane between the centres) with the widest gap to
    another body.
    """
    if not body.outlined:
        normal = between / np.linalg.norm(between)
        level = (body.vertices @ normal).max()
        return normal, level, (other.vertices @ normal).min() - level
    gaps = (other.vertices @ body.normals.T).min(axis=0) - body.offsets
    best = int(np.argmax(gaps))
    return body.normals[best], body.offsets[best], gaps[best]


def _topological_order(
    after: Sequence[Sequence[int]], waits: np.ndarray, distance: np.ndarray
) -> list[int]:
    """Topological order, the farthest of those that are free first; a cycle is cut at its farthest."""
    waits = waits.copy()
    done = np.zeros(len(after), bool)
    free = [(-distance[k], k) for k in range(len(after)) if waits[k] == 0]
    heapq.heapify(free)
    order: list[int] = []
    while len(order) < len(after):
        if not free:
            k = int(np.argmax(np.where(done, -np.inf, distance)))
        else:
            k = heapq.heappop(free)[1]
        if done[k]:
            continue
        done[k] = True
        order.append(k)
        for n in after[k]:
            waits[n] -= 1
            if waits[n] == 0 and not done[n]:
                heapq.heappush(free, (-distance[n], n))
    return order
