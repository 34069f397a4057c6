"""Checks that samples resolve the peak of a contact, and notes on times that are not multiples of
them.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.assembly.time_step import PossibleContact
from dem_jax.contact_laws import ContactLaw
from dem_jax.scene.sections.run_settings import RunSettings

ROUNDED = 0.01  # of run.duration: a smaller difference is not mentioned
ROUNDED_FRAMES = 0.1  # the same for run.frames (the default, 1 ms, is 33 samples of 30 us)
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
        f"run.sample = {sample:.3g} s: the shortest contacts last {shortest:.2g} s, less than {FEWEST_SAMPLES} samples, whose peaks can be "
        f"too low; peak_force has those of every step, and run.sample = {shortest / FEWEST_SAMPLES:.2g} or less would show them"
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
    if abs(samples * run.sample / run.duration - 1) > ROUNDED:
        found.append(
            f"run.duration = {run.duration:g} s is no multiple of run.sample = {run.sample:g} s: the run has {samples} samples and "
            f"ends at {samples * run.sample:.6g} s"
        )
    frames_asked = run.frames != RunSettings.model_fields["frames"].default
    if frames_asked and run.frames > run.duration * (1 + ROUNDED):
        found.append(
            f"run.frames = {run.frames:g} s is longer than run.duration = {run.duration:g} s: only the first pose is stored"
        )
    elif (
        frames_asked
        and frame_every
        and abs(frame_every * run.sample / run.frames - 1) > ROUNDED_FRAMES
    ):
        found.append(
            f"run.frames = {run.frames:g} s is no multiple of run.sample = {run.sample:g} s: poses are stored every "
            f"{frame_every * run.sample:.4g} s"
        )
    if run.step != "auto" and run.step > run.sample * (1 + ROUNDED):
        found.append(
            f"run.step = {run.step:g} s is longer than run.sample = {run.sample:g} s: no step is longer than a sample, "
            f"steps are of {run.sample:g} s"
        )
    return found
