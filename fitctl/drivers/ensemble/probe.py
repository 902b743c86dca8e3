"""A controller asked: its axes stay as they are."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import EnsembleDevice, Siderostat
from fitctl.drivers.ensemble.link import DEVICE, EnsembleLink
from fitctl.drivers.ensemble.protocol import (
    Parameter,
    Reply,
    fault_text,
    parse_bits,
    parse_number,
)
from fitctl.drivers.interface import DeviceIdentity, DeviceRefused
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
        link.probe()
        for axis in device.axes:
            low, high = (
                parse_number(_value(link, f"GETPARM(@{axis}, {parameter.value})"))
                for parameter in (Parameter.SOFTWARE_LIMIT_LOW, Parameter.SOFTWARE_LIMIT_HIGH)
            )
            if low >= high:
                disagreements.append(
                    f"axis @{axis} has no software limits: set SoftwareLimitLow and SoftwareLimitHigh"
                )
            faults = parse_bits(_value(link, f"AXISFAULT(@{axis})"))
            if faults:
                disagreements.append(
                    f"axis @{axis} is in fault ({fault_text(faults)}): remove its cause"
                )
        question_s = round_trip_s(lambda: link.query(f"PFBKPROG(@{device.axes[0]})"))
    axes = " and ".join(f"@{axis}" for axis in device.axes)
    identity = DeviceIdentity("Aerotech", f"Ensemble, axes {axes}", "", "")
    return Probe(identity, question_s, tuple(disagreements))


def _value(link: EnsembleLink, text: str) -> str:
    answer = link.query(text)
    if isinstance(answer, Reply):
        got = answer.name.lower().replace("_", " ")
        hint = "check siderostat.device.axes"
        raise DeviceRefused(DEVICE, link.endpoint, f"an answer to {text}", got, hint)
    try:
        parse_number(answer)
    except ValueError:
        raise link.nonsense(f"a number in answer to {text}", repr(answer)) from None
    return answer
