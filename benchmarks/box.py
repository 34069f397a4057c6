"""The box that benchmarks put pieces into."""


def open_box(x, y, z):
    """Corners of floor and sides, seen from inside, of a box on z = 0 without a lid: half widths x,
    y and height z (m).
    """
    return [
        [(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)],
        [(-x, -y, 0.0), (-x, y, 0.0), (-x, y, z), (-x, -y, z)],
        [(x, y, 0.0), (x, -y, 0.0), (x, -y, z), (x, y, z)],
        [(x, -y, 0.0), (-x, -y, 0.0), (-x, -y, z), (x, -y, z)],
        [(-x, y, 0.0), (x, y, 0.0), (x, y, z), (-x, y, z)],
    ]
