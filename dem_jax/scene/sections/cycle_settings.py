"""The cycle of a weighing station as a timeline that is gone through again and again."""

from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator

from dem_jax.scene.sections.base import Positive, Section, as_tuple

TimeSpan = Annotated[tuple[float, float], BeforeValidator(as_tuple)]


class FlapTimes(Section):
    """When the flaps of a bucket move, s from the beginning of the cycle."""

    opens: TimeSpan = Field(description="s: from when to when they open")
    closes: TimeSpan = Field(description="s: from when to when they close")

    @model_validator(mode="after")
    def _is_in_order(self) -> "FlapTimes":
        if not self.opens[0] < self.opens[1] <= self.closes[0] < self.closes[1]:
            shown = f"opens = {list(self.opens)}, closes = {list(self.closes)}"
            raise ValueError(f"{shown}: allowed: begin < end of opening <= begin < end of closing")
        return self


class Cycle(Section):
    """Table 1 of the paper: WB opens and closes, FB does so once WB is open, LF vibrates once FB is
    shut; and again each period.

    Takes the place of the times of the buckets' and the feeder's own sections. The first cycle
    begins so that FB begins to open at time zero, the release.
    """

    period: Positive = Field(description="s from one cycle to the next")
    wb: FlapTimes = Field(description="weigh bucket")
    fb: FlapTimes = Field(description="feed bucket: opens when the flaps of WB are open, or later")
    lf: TimeSpan | None = Field(
        None, description="s: from when to when the linear feeder vibrates; unset: never"
    )

    @model_validator(mode="after")
    def _is_that_of_table_1(self) -> "Cycle":
        wb, fb, lf = self.wb, self.fb, self.lf
        if fb.opens[0] < wb.opens[1]:
            raise ValueError(
                f"fb.opens = {list(fb.opens)}: FB opens before WB is open; allowed: from {wb.opens[1]:g} s on"
            )
        for name, each in (("wb", wb), ("fb", fb)):
            if each.closes[1] > each.opens[0] + self.period:
                late = f"{name}.closes = {list(each.closes)}: {name.upper()} is not shut when it opens again"
                raise ValueError(f"{late}; allowed: until {each.opens[0] + self.period:g} s")
        if lf is not None and not fb.closes[1] <= lf[0] < lf[1] <= fb.opens[0] + self.period:
            span = f"from {fb.closes[1]:g} s, when FB is shut, to {fb.opens[0] + self.period:g} s, when it opens again"
            raise ValueError(f"lf = {list(lf)}: allowed: within {span}")
        return self
