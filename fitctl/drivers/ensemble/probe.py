"""A controller asked: its axes stay as they are."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import EnsembleDevice, Siderostat
from fitctl.drivers.ensemble.link import EnsembleLink
from fitctl.drivers.ensemble.protocol import Parameter, fault_text, parse_bits, parse_number
from fitctl.drivers.probe import Probe, round_trip_s


def probe_ensemble(siderostat: Siderostat[EnsembleDevice]) -> Probe:
    """Whether a controller has both axes, their software limits, and no fault.

    Raises
    ------
    DeviceError
        If it does not answer, or has no such axes.
    """
    device = siderostat.device
    disagreements = []
    with closing(EnsembleLink(device)) as link:
        identity = link.probe()
        for axis in device.axes:
            low, high = (
                link.value(f"GETPARM(@{axis}, {parameter.value})", parse_number)
                for parameter in (Parameter.SOFTWARE_LIMIT_LOW, Parameter.SOFTWARE_LIMIT_HIGH)
            )
            if low >= high:
                disagreements.append(
                    f"axis @{axis} has no software limits: set SoftwareLimitLow and SoftwareLimitHigh"
                )
            faults = link.value(f"AXISFAULT(@{axis})", parse_bits)
            if faults:
                disagreements.append(
                    f"axis @{axis} is in fault ({fault_text(faults)}): remove its cause"
                )
        question_s = round_trip_s(lambda: link.query(f"PFBKPROG(@{device.axes[0]})"))
    return Probe(identity, question_s, tuple(disagreements))
