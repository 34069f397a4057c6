"""Selecting and grouping against numpy."""

import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax.math import compaction


@pytest.mark.parametrize(
    ("length", "share"),
    [(1, 0.0), (1, 1.0), (31, 0.5), (32, 1.0), (1000, 0.0), (1000, 0.02), (1000, 0.7)],
)
@pytest.mark.parametrize("slots", [1, 64, 1500])
def test_the_first_entries_that_hold_are_found_in_order(length, share, slots):
    mask = np.random.default_rng(0).random(length) < share
    count, where = compaction.find_set_entries(jnp.asarray(mask), slots)
    (expected,) = np.nonzero(mask)
    assert int(count) == len(expected)
    kept = expected[:slots]
    np.testing.assert_array_equal(
        where, np.concatenate([kept, np.full(slots - len(kept), compaction.EMPTY)])
    )


@pytest.mark.parametrize(
    ("places", "groups"), [(500, 70), (60_000, 40_000), (1_100_000, 4_000_000)]
)
def test_places_are_grouped_by_owner_whatever_their_number(places, groups):
    """In one key, in two digits, and with keys too large for either."""
    owner = np.random.default_rng(1).integers(0, groups + 1, places).astype(np.int32)
    order, first = compaction.group_by_owner(jnp.asarray(owner), groups)
    expected = np.argsort(owner, kind="stable")
    np.testing.assert_array_equal(order, expected)
    np.testing.assert_array_equal(first, np.searchsorted(owner[expected], np.arange(groups + 1)))
