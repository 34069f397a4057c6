"""The rows of the benchmark of skips: scenes that can be built, and proofs that there are."""

import re
from pathlib import Path

import pytest

from benchmarks import skips

TESTS = Path(__file__).parents[1] / "dem_jax"
ROWS = skips.skips(quick=False)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_each_row_names_tests_that_there_are(row):
    for proof in row.test.split(", "):
        file, _, word = proof.partition(": ")
        names = re.findall(r"^def (test_\w+)", (TESTS / file).read_text(), re.MULTILINE)
        assert any(word in name for name in names)


@pytest.mark.parametrize("row", skips.skips(quick=True), ids=lambda row: row.name)
def test_each_row_has_something_to_leave_out(row):
    """Scenes are valid; what is computed all the same differs from what is left out."""
    scene = row.scene()
    assert scene.piece and (row.computed or row.frames or row.other() != scene)
    if row.needing:
        assert row.needing[1]() != scene
