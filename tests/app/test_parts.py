"""Parts of the pages that need no browser."""

import pytest

pytest.importorskip("nicegui")

from dem_jax.app.facts import Curve
from dem_jax.app.pages.parts import find_span


def test_a_chart_begins_with_the_first_strong_impact_and_ends_after_the_last_piece():
    force = Curve([0.0, 203.0, 208.0, 300.0, 420.0, 990.0], [0.0, 1.0, 8.9, 0.4, 0.2, 0.1])
    settled = Curve([0.0, 290.0, 290.0, 400.0, 400.0, 990.0], [0.0, 0.0, 50.0, 50.0, 100.0, 100.0])
    assert find_span([force], [settled]) == (170.0, 430.0)
    assert find_span([None], [settled]) == (270.0, 420.0), "a bucket without a force"
    assert find_span([force], [None]) == (190.0, 220.0)
    short, late = (
        Curve([0.0, 203.0, 300.0], [0.0, 1.0, 0.5]),
        Curve([0.0, 500.0, 510.0], [0.0, 3.0, 0.0]),
    )
    assert find_span([short], [None]) == (190.0, 220.0)
    assert find_span([short, late], [None, None]) == (150.0, 510.0), "of all; not beyond the data"


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_a_chart_of_no_impact_shows_all(value):
    flat = Curve([0.0, 1.0], [value, value])
    assert find_span([flat], [flat]) is None
    assert find_span([Curve([], [])], [Curve([], [])]) is None
