"""Pictures of pieces as SVG, drawn to scale."""

from collections.abc import Sequence

import numpy as np

from dem_jax.math.loops import area_vector
from dem_jax.shapes import Shape, surface_mesh

PIXELS_PER_MM = 1.9
WIDTH, HEIGHT = 150, 84  # pixels
BAR = 10.0  # mm, of the scale that each picture has
TURN, TILT = np.radians(-28.0), np.radians(24.0)  # from where pieces are seen
LIGHT = np.array([-0.35, 0.55, 0.76])
BALL = np.concatenate([np.eye(3), -np.eye(3)])  # points of a sphere of radius 1
PAINT = np.array([232.0, 176.0, 108.0])


def draw_piece(shape: Shape) -> str:
    """A piece as SVG, at the scale of all others, with a bar of 10 mm."""
    is_round = shape.radius > 0.0
    points, faces = (shape.radius * BALL, ()) if is_round else surface_mesh(shape)
    seen = points if is_round else _turn_points(_lay_along(points))
    seen = seen * 1e3 * PIXELS_PER_MM
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    scale = min(
        1.0, (WIDTH - 8) / max(high[0] - low[0], 1e-9), (HEIGHT - 20) / max(high[1] - low[1], 1e-9)
    )
    middle = 0.5 * (low + high)
    seen = (seen - [*middle, 0.0]) * scale
    body = _draw_ball(seen) if is_round else _draw_faces(seen, faces)
    bar = BAR * PIXELS_PER_MM * scale
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" aria-hidden="true">'
        f'<g transform="translate({WIDTH / 2} {(HEIGHT - 14) / 2}) scale(1 -1)">{body}</g>'
        f'<path d="M{WIDTH - 4 - bar:.1f} {HEIGHT - 5}h{bar:.1f}" stroke="#475569" stroke-width="2"/>'
        f'<text x="{WIDTH - 8 - bar:.1f}" y="{HEIGHT - 2}" font-size="9" fill="#475569" text-anchor="end">10 mm</text></svg>'
    )


def _lay_along(points: np.ndarray) -> np.ndarray:
    """Points turned by quarter turns so that their largest extent is along x and their smallest
    along z.
    """
    order = np.argsort(-np.ptp(points, axis=0), kind="stable")
    turned = points[:, order]
    is_mirrored = np.linalg.det(np.eye(3)[:, order]) < 0
    return turned * [1.0, -1.0, 1.0] if is_mirrored else turned


def _turn_points(points: np.ndarray) -> np.ndarray:
    """Points as seen: to the right, up and towards the eye."""
    x, y, z = np.asarray(points, float).T
    right, away = np.cos(TURN) * x + np.sin(TURN) * y, -np.sin(TURN) * x + np.cos(TURN) * y
    up = np.cos(TILT) * z + np.sin(TILT) * away
    near = np.sin(TILT) * z - np.cos(TILT) * away
    return np.stack([right, up, near], axis=1)


def _draw_ball(seen: np.ndarray) -> str:
    radius = 0.5 * float(np.ptp(seen[:, 0]))
    shine = 0.45 * radius
    return (
        f'<circle r="{radius:.2f}" fill="rgb(226,170,102)" stroke="#7c5a2c" stroke-width=".7"/>'
        f'<circle cx="{-0.3 * radius:.2f}" cy="{0.35 * radius:.2f}" r="{shine:.2f}" fill="#fff" opacity=".35"/>'
    )


def _draw_faces(seen: np.ndarray, faces: Sequence[Sequence[int]]) -> str:
    """The faces that look at the eye, the nearest last."""
    drawn = []
    for face in faces:
        corners = seen[list(face)]
        normal = area_vector(corners)
        length = float(np.linalg.norm(normal))
        if length <= 0.0 or normal[2] <= 0.0:
            continue
        tone = np.clip(PAINT * (0.62 + 0.42 * float(normal @ LIGHT) / length), 0, 255).astype(int)
        place = " ".join(f"{x:.1f},{y:.1f}" for x, y, _ in corners)
        paint = f"rgb({tone[0]},{tone[1]},{tone[2]})"
        edge = "#7c5a2c" if len(faces) <= 40 else paint
        polygon = f'<polygon points="{place}" fill="{paint}" stroke="{edge}" stroke-width=".6" stroke-linejoin="round"/>'
        drawn.append((float(corners[:, 2].mean()), polygon))
    return "".join(polygon for _, polygon in sorted(drawn))
