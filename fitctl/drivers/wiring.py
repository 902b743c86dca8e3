"""Drivers behind cables that do not go straight: the rig's order and signs, put about any driver.

Above are azimuth and elevation, and stack 1 to 3; below, the axes and channels of a device.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config.wiring import AmplifierWiring
from fitctl.drivers.interface import (
    AzEl,
    BusAmplifiers,
    MirrorDac,
    PiezoAmplifier,
    ServoAmplifiers,
    ServoReading,
)


class Crossing(NamedTuple):
    """From a siderostat's axes to those of its amplifiers, and back.

    Attributes
    ----------
    first, second : int
        Whose command the amplifiers' axis 0 gets, and axis 1: 0 azimuth's, 1 elevation's.
    velocity_signs, encoder_signs : tuple of int
        Of azimuth and elevation.
    """

    first: int
    second: int
    velocity_signs: tuple[int, int]
    encoder_signs: tuple[int, int]

    def commands(self, velocity_rad_s: AzEl) -> AzEl:
        """What the amplifiers' axes 0 and 1 are commanded."""
        az, el = self.velocity_signs
        wanted = (az * velocity_rad_s[0], el * velocity_rad_s[1])
        return wanted[self.first], wanted[self.second]

    def angles(self, counted_rad: AzEl) -> AzEl:
        """The motors' angles, azimuth and elevation, of what the encoders on axes 0 and 1 count."""
        az, el = self.encoder_signs
        return az * counted_rad[self.first], el * counted_rad[self.second]


def crossing(wiring: AmplifierWiring) -> Crossing:
    """As a wiring says; of two axes, an exchange is its own inverse."""
    first, second = wiring.axes
    velocity, encoder = wiring.velocity_signs, wiring.encoder_signs
    return Crossing(first, second, (velocity[0], velocity[1]), (encoder[0], encoder[1]))


class WiredAmplifiers:
    """Amplifiers whose axes and signs are the siderostat's (:class:`fitctl.drivers.interface.BusAmplifiers`).

    Parameters
    ----------
    amplifiers : ServoAmplifiers
    wiring : AmplifierWiring
    """

    def __init__(self, amplifiers: ServoAmplifiers, wiring: AmplifierWiring) -> None:
        self._amplifiers = amplifiers
        self._crossing = crossing(wiring)
        self.open = amplifiers.open
        self.enable = amplifiers.enable
        self.disable = amplifiers.disable
        self.reset_fault = amplifiers.reset_fault
        self.close = amplifiers.close

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: command both motors, read both encoders."""
        reading = self._amplifiers.exchange(self._crossing.commands(velocity_rad_s))
        if reading is None:
            return None
        return reading._replace(position_rad=self._crossing.angles(reading.position_rad))


class WiredBusAmplifiers(WiredAmplifiers):
    """The same on a bus of several."""

    def __init__(self, amplifiers: BusAmplifiers, wiring: AmplifierWiring) -> None:
        super().__init__(amplifiers, wiring)
        self._on_bus = amplifiers

    def stage(self, velocity_rad_s: AzEl) -> None:
        """Begin a servo period that :meth:`exchange` ends: have the command ready for the bus."""
        self._on_bus.stage(self._crossing.commands(velocity_rad_s))


class WiredDac:
    """A D/A whose channels are in the order of the stacks (:class:`fitctl.drivers.interface.MirrorDac`).

    Parameters
    ----------
    dac : MirrorDac
    channels : list of int
        Of stack 1 to 3, from 1.
    """

    def __init__(self, dac: MirrorDac, channels: list[int]) -> None:
        self._dac = dac
        self._of_stacks = np.array(channels) - 1
        self._of_channels = np.argsort(self._of_stacks)
        self.open = dac.open
        self.confirm = dac.confirm
        self.close = dac.close

    def send_v(self, volts: NDArray[np.float64]) -> None:
        """Send the command that sets all three channels at once; shape (3,), stack 1 first."""
        self._dac.send_v(volts[self._of_channels])

    def read_v(self) -> NDArray[np.float64]:
        """Read what the channels are set to; shape (3,), stack 1 first."""
        return self._dac.read_v()[self._of_stacks]


class WiredPiezo:
    """A piezo amplifier in the order of the stacks (:class:`fitctl.drivers.interface.PiezoAmplifier`).

    Parameters
    ----------
    piezo : PiezoAmplifier
    channels : list of int
        Of stack 1 to 3, from 1.
    """

    def __init__(self, piezo: PiezoAmplifier, channels: list[int]) -> None:
        self._piezo = piezo
        self._of_stacks = np.array(channels) - 1
        self.open = piezo.open
        self.limit_v = piezo.limit_v
        self.close = piezo.close

    def stack_volts(self) -> NDArray[np.float64]:
        """Measured output, shape (3,), stack 1 first, at the stack."""
        return self._piezo.stack_volts()[self._of_stacks]
