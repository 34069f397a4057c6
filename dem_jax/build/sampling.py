"""Whether samples are close enough to show the peak of a contact."""

from collections.abc import Sequence

import numpy as np

from dem_jax.build.time_step import PossibleContact
from dem_jax.contact.law import ContactLaw

FEWEST = 3  # samples in a contact: of half a sine the largest of three evenly spaced is within 1 - sin(pi / 3) = 13 % of its top


def shortest_contact(law: ContactLaw, contacts: Sequence[PossibleContact]) -> float:
    """How long (s) the shortest of the contacts that a scene can have lasts: a quarter period on the branch that loads and one on
    the branch that unloads, of the effective mass of an impact off the centre of mass. About: the law's stiffest is taken."""
    loading = getattr(law, "loading_step", law.stable_step)
    masses = ((c, c.mass * c.eccentricity) for c in contacts)
    twice = [np.min(np.asarray(loading(c.pair, mass)) + np.asarray(law.stable_step(c.pair, mass))) for c, mass in masses]
    return 0.25 * np.pi * float(min(twice))  # a step is 2 / omega, a quarter period pi / 2 omega


def note(sample: float, shortest: float) -> str | None:
    """What to say of samples (s) that the shortest contact (s) can slip between; None: nothing."""
    if shortest >= FEWEST * sample:
        return None
    return (
        f"run.sample = {sample:.3g} s: the shortest contacts last {shortest:.2g} s, less than {FEWEST} samples, whose peaks can be "
        f"too low; peak_force has those of every step, and run.sample = {shortest / FEWEST:.2g} or less would show them"
    )
