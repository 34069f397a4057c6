"""Checks that samples resolve the peak of a contact, and notes on times that are not multiples of
them.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.assembly.time_step import PossibleContact
from dem_jax.contact_laws import ContactLaw
from dem_jax.scene.sections.run_settings import RunSettings

ROUNDED = 0.01  # of run.duration: a smaller difference is not mentioned
ROUNDED_FRAMES = 0.1  # the same for run.frame_interval (the default, 1 ms, is 33 samples of 30 us)
FEWEST_SAMPLES = 3  # samples in a contact: the largest of three evenly spaced values of a half sine
# is within 1 - sin(pi / 3) = 13 % of its peak


def shortest_contact_time(law: ContactLaw, contacts: Sequence[PossibleContact]) -> float:
    """Approximate duration (s) of the shortest contact that a scene can have: a quarter period on
    the loading branch and one on the unloading branch, for the effective mass of an off-centre
    impact and the largest stiffness of the law.
    """
    loading = getattr(law, "loading_step", law.stable_step)
    masses = ((c, c.mass * c.normal_mass_ratio) for c in contacts)
    twice = [
        np.min(np.asarray(loading(c.pair, mass)) + np.asarray(law.stable_step(c.pair, mass)))
        for c, mass in masses
    ]
    return 0.25 * np.pi * float(min(twice))  # a step is 2 / omega, a quarter period pi / 2 omega


def note_coarse_sampling(sample: float, shortest: float) -> str | None:
    """A note if the shortest contact (s) can fall between samples (s), else None."""
    if shortest >= FEWEST_SAMPLES * sample:
        return None
    return (
        f"run.sample_interval = {sample:.3g} s: the shortest contacts last {shortest:.2g} s, less than "
        f"{FEWEST_SAMPLES} samples, whose peaks can be too low; peak_force has those of every step, "
        f"and run.sample_interval = {shortest / FEWEST_SAMPLES:.2g} or less would show them"
    )


def note_rounded_times(run: RunSettings, samples: int, frame_every: int) -> list[str]:
    """Notes on times of a scene that are rounded to whole samples or otherwise act differently than
    written.

    Args:
        run: the section of the scene.
        samples: number of samples of the run.
        frame_every: samples between stored poses; 0: none.
    """
    found = []
    if abs(samples * run.sample_interval / run.duration - 1) > ROUNDED:
        found.append(
            f"run.duration = {run.duration:g} s is no multiple of run.sample_interval = {run.sample_interval:g} s: "
            f"the run has {samples} samples and ends at {samples * run.sample_interval:.6g} s"
        )
    frames_asked = run.frame_interval != RunSettings.model_fields["frame_interval"].default
    if frames_asked and run.frame_interval > run.duration * (1 + ROUNDED):
        found.append(
            f"run.frame_interval = {run.frame_interval:g} s is longer than run.duration = {run.duration:g} s: only the first pose is stored"
        )
    elif (
        frames_asked
        and frame_every
        and abs(frame_every * run.sample_interval / run.frame_interval - 1) > ROUNDED_FRAMES
    ):
        found.append(
            f"run.frame_interval = {run.frame_interval:g} s is no multiple of run.sample_interval = {run.sample_interval:g} s: "
            f"poses are stored every {frame_every * run.sample_interval:.4g} s"
        )
    if run.time_step != "auto" and run.time_step > run.sample_interval * (1 + ROUNDED):
        found.append(
            f"run.time_step = {run.time_step:g} s is longer than run.sample_interval = {run.sample_interval:g} s: "
            f"no step is longer than a sample, steps are of {run.sample_interval:g} s"
        )
    return found
