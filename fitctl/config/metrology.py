"""The rig file's metrology loops: a laser beam over a link, and the photodiodes that it is held on."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fitctl.config.base import Count, NonNegative, Positive, Settings
from fitctl.config.devices import AnySiderostat, LabJackT7Device
from fitctl.config.loops import FieldOverlap

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
            msg = (
                f"on_axis_v and ambient_v give {brightest_v:g} V with the beam on the centre; "
                f"must be below saturated_v, {self.saturated_v:g} V"
            )
            raise ValueError(msg)
        return self


class MetrologySensor(BeamSensor):
    """What is known of the photodiodes, and the device that reads them.

    ``link_delay_s`` is the time from a sample to the tick that uses it.
    """

    link_delay_s: NonNegative
    device: LabJackT7Device


class BeamAcquisition(Settings):
    """How the beam is searched for, and when it counts as found or lost.

    Without ``search_again_s``, the search for a beam that was held and lost ends only on a command.
    """

    search_radius_sky_arcsec: Positive
    detection_sigma: Annotated[float, Field(ge=3, le=100)]
    found_frames: Count
    lost_frames: Count
    field_overlap: FieldOverlap
    settle_s: NonNegative
    confirm_timeout_s: Positive
    search_again_pause_s: NonNegative
    search_again_s: NonNegative | None = None


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
            msg = (
                f"second_integrator_hz may be at most half of crossover_hz, {self.crossover_hz / 2:g}, "
                "or the loop would swing"
            )
            raise ValueError(msg)
        return self


class MetrologyLoop(Settings):
    """One metrology loop: its siderostat holds a laser beam on photodiodes at the other end of a link."""

    kind: Literal["metrology"]
    requirement_arcsec: Positive
    siderostat: AnySiderostat
    sensor: MetrologySensor
    acquisition: BeamAcquisition
    hold: Hold
