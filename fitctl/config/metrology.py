"""The rig file's metrology loops: a laser beam over a link, and the photodiodes that it is held on."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fitctl.config.base import DelayS, NonNegative, Positive, Settings
from fitctl.config.conflict import Conflict, Conflicts, Part, above, at_least, at_most, below
from fitctl.config.devices import AnySiderostat, LabJackT7Device
from fitctl.config.loops import Acquisition

FourVolts = Annotated[list[NonNegative], Field(min_length=4, max_length=4)]


class BeamSensor(Settings):
    """A Gaussian beam on four photodiodes, at ``diode_offset_m`` from their centre on each axis.

    Attributes
    ----------
    diode_offset_m : float
        From the centre of the array to each photodiode.
    beam_radius_m : float
        1/e^2 radius of the beam at the array.
    link_length_m : float
        From the siderostat that points the beam to the array.
    on_axis_v : float
        Each photodiode's voltage above ambient with the beam on the centre of the array.
    noise_v : float
        One standard deviation of one sample.
    ambient_v : list of float
        Voltages without the beam: az+, az-, el+, el-.
    saturated_v : float
        The largest voltage that is a measurement.
    """

    diode_offset_m: Positive
    beam_radius_m: Positive
    link_length_m: Positive
    on_axis_v: Positive
    noise_v: Positive
    ambient_v: FourVolts
    saturated_v: Positive

    @model_validator(mode="after")
    def _on_axis_is_measured(self) -> BeamSensor:
        brightest_v = self.on_axis_v + max(self.ambient_v)
        if brightest_v >= self.saturated_v:
            parts = (
                below("on_axis_v", self.on_axis_v, self.saturated_v - max(self.ambient_v)),
                above("saturated_v", self.saturated_v, brightest_v),
                Part(
                    "ambient_v", self.ambient_v, f"below {self.saturated_v - self.on_axis_v:g} each"
                ),
            )
            why = f"with the beam on the centre a photodiode gives {brightest_v:g} V"
            raise Conflicts([Conflict(why, parts)])
        return self


class MetrologySensor(BeamSensor):
    """What is known of the photodiodes, and the device that reads them.

    ``link_delay_s`` is the time from a sample to the tick that uses it.
    """

    link_delay_s: DelayS
    device: LabJackT7Device


class Hold(Settings):
    """How the siderostat holds the beam on the centre of the array.

    Attributes
    ----------
    crossover_hz : float
        Of the integrator.
    second_integrator_hz : float
        Below, a second integrator works as well, so that a steady motion leaves no error; 0 is none.
    """

    crossover_hz: Positive
    second_integrator_hz: NonNegative

    @model_validator(mode="after")
    def _second_is_slower(self) -> Hold:
        if self.second_integrator_hz > self.crossover_hz / 2:
            second_hz = self.second_integrator_hz
            parts = (
                at_most("second_integrator_hz", second_hz, self.crossover_hz / 2),
                at_least("crossover_hz", self.crossover_hz, 2 * second_hz),
            )
            raise Conflicts([Conflict("the loop would swing", parts)])
        return self


class MetrologyLoop(Settings):
    """One metrology loop: its siderostat holds a laser beam on photodiodes at the other end of a link."""

    kind: Literal["metrology"]
    requirement_arcsec: Positive
    siderostat: AnySiderostat
    sensor: MetrologySensor
    acquisition: Acquisition
    hold: Hold
