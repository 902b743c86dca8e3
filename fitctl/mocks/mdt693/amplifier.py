"""The analogue half of an MDT693: what its three outputs are, and what it measures of them. No I/O."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np

from fitctl.config import Mdt693Mock
from fitctl.drivers.mdt693.protocol import LIMIT_MARGIN_V, LIMIT_SWITCH_V

CHANNELS = "xyz"
_HIGHEST_V = LIMIT_SWITCH_V[-1] + LIMIT_MARGIN_V


class OutOfLimitsError(Exception):
    """A value that the limits do not allow."""


class Amplifier:
    """Three channels: knob, set-point, master scan and external input are added, and then limited.

    The outputs follow at once; what is measured of them follows as the settings say, with their
    offset and noise.

    Parameters
    ----------
    settings : Mdt693Mock
        Switch, knobs, and how well it measures.
    gain : float
        From external input to output, where the settings have no others.
    on_outputs : callable
        Gets the three output voltages whenever one changes.
    now_s : callable
        The time.
    """

    _set_v: list[float]
    _low_v: dict[int | None, float]
    _high_v: dict[int | None, float]

    def __init__(
        self,
        settings: Mdt693Mock,
        gain: float,
        on_outputs: Callable[[Sequence[float]], None],
        now_s: Callable[[], float],
    ) -> None:
        self._settings = settings
        self._gains = settings.true_gains or [gain] * len(CHANNELS)
        self._on_outputs = on_outputs
        self._now_s = now_s
        self._noise = np.random.default_rng(0)
        self._external_v = [0.0] * 3
        self._saturated: Collection[str] = ()
        self._powered = True
        self.switch_v = float(settings.limit_switch_v)
        self._set_defaults()
        self.outputs_v = self._computed()
        self._followed_v = self.outputs_v
        self._followed_s = now_s()

    # ------------------------------------------------------------------ from outside
    def set_external_input_v(self, volts: Sequence[float]) -> None:
        """What the external inputs are given, three voltages before the gain."""
        self._external_v = list(volts)
        self._update()

    def set_switch_v(self, volts: float) -> None:
        """Turn the voltage-limit switch, to the nearest position that it has."""
        self.switch_v = float(min(LIMIT_SWITCH_V, key=lambda position: abs(position - volts)))
        self._update()

    def set_saturated(self, channels: Collection[str]) -> None:
        """These outputs stay at their highest voltage, whatever is commanded."""
        self._saturated = channels
        self._update()

    def set_powered(self, powered: bool) -> None:
        """Without power the outputs are at 0 V; with it again, everything is as at power-up."""
        self._powered = powered
        self.restore()

    # ------------------------------------------------------------------ from the serial line
    def restore(self) -> None:
        """Set-points, limits and master scan to their defaults."""
        self._set_defaults()
        self._update()

    def set_points(self, volts: Sequence[float | None]) -> None:
        """New set-points for some channels, all of them or none.

        Raises
        ------
        OutOfLimitsError
        """
        wanted = [old if new is None else new for old, new in zip(self._set_v, volts, strict=True)]
        for i, new in enumerate(volts):
            if new is not None and not self.low_v(i) <= new <= self.high_v(i):
                raise OutOfLimitsError
        self._set_v = wanted
        self._update()

    def step(self, channel: int, volts: float) -> None:
        """Move one set-point, as far as its limits let it."""
        moved = self._set_v[channel] + volts
        self._set_v[channel] = min(self.high_v(channel), max(self.low_v(channel), moved))
        self._update()

    def set_scan(self, volts: float | None) -> None:
        """Add this to all channels; None for no master scan."""
        self._scan_v = volts or 0.0
        self._update()

    def low_v(self, channel: int | None) -> float:
        """The lowest voltage that a channel may have; with None, the system's limit."""
        return max(self._low_v[channel], self._low_v[None])

    def high_v(self, channel: int | None) -> float:
        """The highest voltage that a channel may have; with None, the system's limit."""
        if channel is None:
            return self._high_v[None]
        return min(self._high_v[channel], self._high_v[None], self.switch_v + LIMIT_MARGIN_V)

    def set_low_v(self, channel: int | None, volts: float) -> None:
        """A channel's low limit, or with None the system's.

        Raises
        ------
        OutOfLimitsError
        """
        channels = range(3) if channel is None else [channel]
        if not 0 <= volts <= min(self.high_v(i) for i in channels):
            raise OutOfLimitsError
        self._low_v[channel] = volts
        self._update()

    def set_high_v(self, channel: int | None, volts: float) -> None:
        """A channel's high limit, or with None the system's.

        Raises
        ------
        OutOfLimitsError
        """
        channels = range(3) if channel is None else [channel]
        lowest_v = max(self.low_v(i) for i in channels)
        if not lowest_v <= volts <= self.switch_v + LIMIT_MARGIN_V:
            raise OutOfLimitsError
        self._high_v[channel] = volts
        self._update()

    def measured_v(self, channel: int) -> float:
        """What the device believes one output to be."""
        self._follow()
        noise_v = self._settings.readback_noise_v * self._noise.standard_normal()
        return max(0.0, self._followed_v[channel] + self._settings.readback_offset_v + noise_v)

    # ------------------------------------------------------------------ inside
    def _set_defaults(self) -> None:
        self._set_v = [0.0] * 3
        self._scan_v = 0.0
        self._low_v = dict.fromkeys((0, 1, 2, None), 0.0)
        self._high_v = dict.fromkeys((0, 1, 2, None), _HIGHEST_V)

    def _computed(self) -> list[float]:
        return [self._output_v(i) for i in range(3)]

    def _output_v(self, i: int) -> float:
        if not self._powered:
            return 0.0
        if CHANNELS[i] in self._saturated:
            return self.switch_v + LIMIT_MARGIN_V
        wanted = (
            self._settings.knobs_v[i]
            + self._set_v[i]
            + self._scan_v
            + self._external_v[i] * self._gains[i]
        )
        return min(self.high_v(i), max(self.low_v(i), wanted))

    def _update(self) -> None:
        outputs_v = self._computed()
        if outputs_v != self.outputs_v:
            self._follow()
            self.outputs_v = outputs_v
            self._on_outputs(outputs_v)

    def _follow(self) -> None:
        """Bring the measuring circuit to now, before the outputs change or are read."""
        now_s = self._now_s()
        settling_s = self._settings.readback_settling_s
        rest = math.exp(-(now_s - self._followed_s) / settling_s) if settling_s else 0.0
        self._followed_v = [
            output + (followed - output) * rest
            for output, followed in zip(self.outputs_v, self._followed_v, strict=True)
        ]
        self._followed_s = now_s
