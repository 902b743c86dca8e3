"""Which objects the mock drive has: identity, communication, and both axes' drive profile."""

from __future__ import annotations

from collections.abc import Callable, Container

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import AbortCode, State
from fitctl.mocks.cia402.axis import FAULT_REACTIONS, QUICK_STOP_OPTIONS, Axis, exponent_of
from fitctl.mocks.cia402.dictionary import Dictionary, Entry, SdoAbortError, constant

VENDOR_ID = 0x0000_F170
PRODUCT_CODE = 0x0402_0002
REVISION = 0x0001_0000
SERIAL_NUMBER = 20261121
NAME = "FIT two-axis servo drive (mock)"
HARDWARE = "mock"
SOFTWARE = "1.0"

_MOTOR = 0x0002
_NO_CHANGE = 1
_NO_RAMP = 0
_BY_DECELERATION = 1
_RATES = range(1, 2**32)  # at rate 0 nothing would ever stop
_ABORT_OPTIONS = frozenset(
    {
        protocol.ABORT_IS_NOTHING,
        protocol.ABORT_IS_FAULT,
        protocol.ABORT_DISABLES,
        protocol.ABORT_IS_QUICK_STOP,
    }
)


def identity_objects(node_id: int) -> Dictionary:
    """Objects that say what the drive is, and never change."""
    servo = protocol.DRIVE_PROFILE | _MOTOR << 16
    several_devices = protocol.DRIVE_PROFILE | 0xFFFF << 16
    return {
        (protocol.DEVICE_TYPE, 0): constant("I", several_devices),
        (protocol.SYNC_COB_ID, 0): constant("I", protocol.SYNC_ID),
        (protocol.DEVICE_NAME, 0): constant("s", NAME),
        (protocol.HARDWARE_VERSION, 0): constant("s", HARDWARE),
        (protocol.SOFTWARE_VERSION, 0): constant("s", SOFTWARE),
        (protocol.EMCY_COB_ID, 0): constant("I", protocol.EMCY_BASE + node_id),
        (protocol.IDENTITY, 0): constant("B", 4),
        (protocol.IDENTITY, 1): constant("I", VENDOR_ID),
        (protocol.IDENTITY, 2): constant("I", PRODUCT_CODE),
        (protocol.IDENTITY, 3): constant("I", REVISION),
        (protocol.IDENTITY, 4): constant("I", SERIAL_NUMBER),
        (protocol.SDO_SERVER, 0): constant("B", 2),
        (protocol.SDO_SERVER, 1): constant("I", protocol.SDO_REQUEST_BASE + node_id),
        (protocol.SDO_SERVER, 2): constant("I", protocol.SDO_RESPONSE_BASE + node_id),
        (protocol.ERROR_BEHAVIOUR, 0): constant("B", 1),
        (protocol.ERROR_BEHAVIOUR, 1): constant("B", _NO_CHANGE),
        (protocol.SINGLE_DEVICE_TYPE, 0): constant("I", servo),
        (protocol.SINGLE_DEVICE_TYPE + protocol.AXIS_OFFSET, 0): constant("I", servo),
    }


def axis_objects(
    axis: Axis,
    offset: int,
    *,
    supported_modes: int,
    statusword: Callable[[], int],
    position_counts: Callable[[], int],
    velocity_rad_s: Callable[[], float],
    changed: Callable[[], None],
) -> Dictionary:
    """Drive profile of one axis, `offset` above the first one's.

    Parameters
    ----------
    statusword, position_counts, velocity_rad_s : callable
        What the drive measures or derives.
    changed : callable
        Called after a write that changes the motor's command.
    """

    def set_mode(mode: int) -> None:
        if mode != 0 and not (0 < mode <= 32 and supported_modes >> (mode - 1) & 1):
            raise SdoAbortError(AbortCode.INVALID_VALUE)
        axis.mode = mode
        changed()

    def set_unit(unit: int) -> None:
        if unit & 0xFF_FFFF != protocol.UNIT_RPM or not -3 <= exponent_of(unit) <= 0:
            raise SdoAbortError(AbortCode.INVALID_VALUE)
        if axis.state is State.OPERATION_ENABLED:
            raise SdoAbortError(AbortCode.DEVICE_STATE)
        axis.unit_velocity = unit

    def setting(code: str, name: str, allowed: Container[int]) -> Entry:
        """A number that the axis keeps under this name."""

        def write(value: int) -> None:
            if value not in allowed:
                raise SdoAbortError(AbortCode.INVALID_VALUE)
            setattr(axis, name, value)

        return Entry(code, lambda: getattr(axis, name), write)

    def limit(number: int) -> Entry:
        def write(counts: int) -> None:
            axis.limits_counts[number] = counts

        return Entry("i", lambda: axis.limits_counts[number], write)

    def set_target(velocity: int) -> None:
        axis.target_velocity = velocity

    def in_units(velocity_rad_s: float) -> int:
        return protocol.wrap_int32(round(velocity_rad_s / axis.unit_rad_s))

    objects = {
        protocol.ABORT_OPTION: setting("h", "abort_option", _ABORT_OPTIONS),
        protocol.ERROR_CODE: Entry("H", lambda: axis.error_code, mappable=True),
        protocol.CONTROLWORD: Entry("H", lambda: axis.controlword, axis.control, mappable=True),
        protocol.STATUSWORD: Entry("H", statusword, mappable=True),
        protocol.QUICK_STOP_OPTION: setting("h", "quick_stop_option", QUICK_STOP_OPTIONS),
        protocol.SHUTDOWN_OPTION: constant("h", _NO_RAMP),
        protocol.DISABLE_OPTION: constant("h", _NO_RAMP),
        protocol.HALT_OPTION: constant("h", _BY_DECELERATION),
        protocol.FAULT_REACTION_OPTION: setting("h", "fault_reaction", FAULT_REACTIONS),
        protocol.MODE: Entry("b", lambda: axis.mode, set_mode, mappable=True),
        protocol.MODE_DISPLAY: Entry("b", lambda: axis.mode, mappable=True),
        protocol.POSITION: Entry("i", position_counts, mappable=True),
        protocol.VELOCITY_DEMAND: Entry("i", lambda: in_units(axis.demand_rad_s), mappable=True),
        protocol.VELOCITY_ACTUAL: Entry("i", lambda: in_units(velocity_rad_s()), mappable=True),
        protocol.ACCELERATION: setting("I", "acceleration", _RATES),
        protocol.DECELERATION: setting("I", "deceleration", _RATES),
        protocol.QUICK_STOP_DECELERATION: setting("I", "quick_stop_rate", _RATES),
        protocol.UNIT_VELOCITY: Entry("I", lambda: axis.unit_velocity, set_unit),
        protocol.UNIT_ACCELERATION: constant("I", protocol.UNIT_RPM_PER_S),
        protocol.TARGET_VELOCITY: Entry(
            "i", lambda: axis.target_velocity, set_target, mappable=True
        ),
        protocol.SUPPORTED_MODES: constant("I", supported_modes),
    }
    limits = protocol.POSITION_LIMITS + offset
    return {(index + offset, 0): entry for index, entry in objects.items()} | {
        (limits, 0): constant("B", 2),
        (limits, 1): limit(0),
        (limits, 2): limit(1),
    }
