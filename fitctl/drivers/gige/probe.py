"""A camera asked, without taking control of it."""

from __future__ import annotations

from contextlib import closing

from fitctl.config import Camera
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.features import Features
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.gige.limits import disagreements
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.interface import DeviceError
from fitctl.drivers.probe import Probe, round_trip_s

_ANY_CONTROL = protocol.CONTROL | protocol.CONTROL_EXCLUSIVE
_CONTROLLED = "another program has control of it: a running supervisor, or one to be ended first"


def probe_camera(camera: Camera) -> Probe:
    """Who a camera is, and whether it can be what the rig file says.

    Raises
    ------
    DeviceError
        If it does not answer, or not as a GigE Vision camera.
    """
    device = camera.device
    channel = ControlChannel(device.address, device.gvcp_port, device.response_timeout_s)
    with closing(channel):
        identity = channel.read_identity()
        question_s = round_trip_s(lambda: channel.read_register(Register.VERSION))
        controlled = channel.read_register(Register.CONTROL_PRIVILEGE)
        told = [_CONTROLLED] if controlled & _ANY_CONTROL else []
        try:
            told += disagreements(Features(channel), camera)
        except DeviceError as error:
            told.append(str(error))
    return Probe(identity, question_s, tuple(told))
