"""Landing spheres beside LIGGGHTS; without it, what can be said of the comparison itself."""

import numpy as np
import pytest

from benchmarks import landing
from benchmarks.peers import liggghts

needs_liggghts = pytest.mark.skipif(liggghts.version() is None, reason="needs a program: liggghts")


@needs_liggghts
@pytest.mark.parametrize("name", landing.CASES)
def test_the_force_on_the_floor_is_that_of_liggghts(name, tmp_path):
    case, until, allowed = landing.CASES[name]
    found = landing.apart(case, tmp_path, until)
    assert found.early < allowed and found.impulse < landing.IMPULSE


@needs_liggghts
def test_another_law_would_be_seen(tmp_path):
    """A restitution that is off by a tenth."""
    one, stiffness = landing.ours(landing.single(0.55))
    two = landing.liggghts(landing.single(0.5), stiffness, tmp_path)
    assert np.abs(one.floor - two.floor).max() / two.floor.max() > 0.1


def test_the_spheres_of_a_drop_lie_apart_and_inside():
    case = landing.drop(4, 0.5, 0.3, 0.3)
    between = np.linalg.norm(case.position[:, None] - case.position[None], axis=-1) + np.eye(64)
    assert between.min() > 2 * landing.RADIUS
    assert (
        np.abs(case.position[:, :2]).max() < case.half_width - landing.RADIUS
        and case.position[:, 2].max() < case.height
    )


def test_without_liggghts_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr(landing, "version", lambda: None)
    assert landing.main([]) == 0
    assert "LIGGGHTS is not found" in capsys.readouterr().out
