"""The noise of a scale's signal: electronics, vibration of the floor and of the machine, zero and
trigger.
"""

from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import NotNegative, Positive, Section, as_tuple


class Noise(Section):
    """The noise of the load cell's signal, added where the signal is weighed; the series in the
    file remain without it.

    All values are assumptions ("typical"): no maker publishes them. The levels of the vibration
    make an error of a few tenths of a gram on a bucket of 1 kg, the size at which makers offer to
    compensate floor vibration (0.15 to 0.5 g).
    """

    white: NotNegative = Field(
        5e-5,
        description="kg, standard deviation of white noise of bridge and converter, in readings at 1000 per second",
    )
    quantum: NotNegative = Field(1e-5, description="kg, step of the readings; 0: none")
    floor_frequency: Positive = Field(12.0, description="Hz, of the line in the floor's vibration")
    floor_acceleration: NotNegative = Field(
        2e-3, description="m/s2, amplitude of that line, vertically at the base of the cell"
    )
    band: Annotated[tuple[Positive, Positive], BeforeValidator(as_tuple)] = Field(
        (5.0, 40.0), description="Hz, from and to, of the random part of the floor's vibration"
    )
    band_acceleration: NotNegative = Field(
        1e-3, description="m/s2, rms of that random part, of equal density over the band"
    )
    neighbour_kicks: NotNegative = Field(
        15.0, description="1/s, kicks of neighbouring heads, at random times"
    )
    neighbour_acceleration: NotNegative = Field(
        1e-3,
        description="m/s2, standard deviation of the acceleration at the base with which the frame answers to a kick",
    )
    frame_frequency: Positive = Field(28.0, description="Hz, at which the frame rings after a kick")
    frame_damping_ratio: float = Field(
        0.05, gt=0, lt=1, description="of the critical damping of the frame"
    )
    motor_frequency: Positive = Field(
        120.0, description="Hz, of the vibration of flap motors and feeders"
    )
    motor_acceleration: NotNegative = Field(
        5e-3, description="m/s2, amplitude of that at the base of the cell, while a motor runs"
    )
    motor_starts: NotNegative = Field(5.0, description="1/s, starts of motors, at random times")
    motor_duration: NotNegative = Field(0.09, description="s, for which a motor runs")
    closing_impulse: NotNegative = Field(
        1e-3, description="N s, impulse on the bucket when its own flaps close"
    )
    closing_spread: NotNegative = Field(
        0.1, description="standard deviation of that impulse, relative to it"
    )
    closing_time: float = Field(-0.1, description="s after the release; negative: before it")
    tare: float = Field(0.0, description="kg, reading of the empty bucket")
    tare_spread: NotNegative = Field(
        2e-5, description="kg, standard deviation of the tare from drop to drop"
    )
    drift: NotNegative = Field(
        2e-5,
        description="kg/s, standard deviation of the drift from drop to drop, 0 at the release",
    )
    release_jitter: NotNegative = Field(
        2e-3, description="s, standard deviation of the release after the trigger"
    )

    @model_validator(mode="after")
    def _has_a_band(self) -> "Noise":
        if not self.band[0] < self.band[1]:
            raise ValueError(
                f"band = [{self.band[0]:g}, {self.band[1]:g}]: allowed: a lower and a higher frequency"
            )
        return self
