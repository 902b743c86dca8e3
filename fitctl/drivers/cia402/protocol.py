"""CANopen (CiA 301) and drive profile (CiA 402) as both sides see them: identifiers, codes, codecs.

Sources: CiA 301 (services, SDO, NMT, EMCY, heartbeat); CiA 402-2, published as IEC 61800-7-201
(controlword, statusword, modes); CiA 303-2 / CiA 890 (coding of units). Integers are little-endian.

Units on the wire: positions are encoder counts after quadrature, int32, and wrap. Velocities are
thousandths of a motor revolution per minute, int32, which object 60A9 is set to: drives in the field
take this prefix, and 0.001 rpm is 0.067 counts/s of a 4000-count encoder, where whole counts per
second would be too coarse to hold a position with.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

# ---------------------------------------------------------------- CAN identifiers (CiA 301)
NMT_ID = 0x000
SYNC_ID = 0x080
EMCY_BASE = 0x080
TPDO1_BASE = 0x180
RPDO1_BASE = 0x200
TPDO2_BASE = 0x280
PDO_BASE_STEP = 0x100
"""From one PDO's identifier to the next one's; there are four each way by default."""
SDO_RESPONSE_BASE = 0x580
SDO_REQUEST_BASE = 0x600
HEARTBEAT_BASE = 0x700

PDO_DISABLED = 0x8000_0000
"""Bit of a PDO's COB-ID that takes it out of service."""
PDO_NO_RTR = 0x4000_0000
"""Bit of a TPDO's COB-ID: it may not be asked for by a remote frame."""
ACYCLIC_SYNC = 0
"""Transmission type of a TPDO: sent at the next SYNC after a change."""
EVERY_SYNC = 1
"""Transmission type: sent, or acted on, at each SYNC."""
LAST_SYNC = 240
"""Transmission types up to this one: sent at every so many SYNCs."""
RTR_AT_SYNC = 252
"""Transmission type of a TPDO: sampled at SYNC, sent when asked for by a remote frame."""
RTR_ONLY = 253
"""Transmission type of a TPDO: sampled and sent when asked for by a remote frame."""
MAKERS_EVENT = 254
"""Transmission type: as `ON_EVENT`, with events of the maker's own."""
ON_EVENT = 255
"""Transmission type: sent on change and by the event timer; acted on at once."""
STATUS_EVERY_MS = 100
"""Event time that the driver gives the TPDO with the statuswords."""


class NmtCommand(IntEnum):
    """Commands of the NMT master to a node."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """The state in a heartbeat; BOOT_UP is sent once."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def master_node_id(drive_node_id: int) -> int:
    """The node id under which our own heartbeat is sent: 127, or 126 if the drive has 127."""
    return 126 if drive_node_id == 127 else 127


# ---------------------------------------------------------------- object dictionary
DEVICE_TYPE = 0x1000
ERROR_REGISTER = 0x1001
ERROR_HISTORY = 0x1003
SYNC_COB_ID = 0x1005
DEVICE_NAME = 0x1008
HARDWARE_VERSION = 0x1009
SOFTWARE_VERSION = 0x100A
EMCY_COB_ID = 0x1014
HEARTBEAT_CONSUMER = 0x1016
HEARTBEAT_PRODUCER = 0x1017
IDENTITY = 0x1018
ERROR_BEHAVIOUR = 0x1029
SDO_SERVER = 0x1200
RPDO_COMMUNICATION = 0x1400
RPDO_MAPPING = 0x1600
TPDO_COMMUNICATION = 0x1800
TPDO_MAPPING = 0x1A00

AXIS_OFFSET = 0x800
"""The second axis' objects stand this much higher."""

ABORT_OPTION = 0x6007
ERROR_CODE = 0x603F
CONTROLWORD = 0x6040
STATUSWORD = 0x6041
QUICK_STOP_OPTION = 0x605A
SHUTDOWN_OPTION = 0x605B
DISABLE_OPTION = 0x605C
HALT_OPTION = 0x605D
FAULT_REACTION_OPTION = 0x605E
MODE = 0x6060
MODE_DISPLAY = 0x6061
POSITION = 0x6064
VELOCITY_DEMAND = 0x606B
VELOCITY_ACTUAL = 0x606C
POSITION_LIMITS = 0x607D
ACCELERATION = 0x6083
DECELERATION = 0x6084
QUICK_STOP_DECELERATION = 0x6085
UNIT_VELOCITY = 0x60A9
UNIT_ACCELERATION = 0x60AA
TARGET_VELOCITY = 0x60FF
SUPPORTED_MODES = 0x6502
SINGLE_DEVICE_TYPE = 0x67FF

DRIVE_PROFILE = 402
PROFILE_VELOCITY = 3
CYCLIC_SYNCHRONOUS_VELOCITY = 9

UNIT_RPM = 0x00B44700
"""Object 60A9: revolutions (B4) per minute (47); the top byte is a signed power of ten."""
UNIT_MILLI_RPM = 0xFDB44700
UNIT_RPM_PER_S = 0x00B44703
"""Object 60AA: revolutions (B4) per minute (47) and second (03)."""

ABORT_IS_NOTHING = 0
ABORT_IS_FAULT = 1
ABORT_DISABLES = 2
ABORT_IS_QUICK_STOP = 3
"""Object 6007: what a lost connection, as that to the master's heartbeat, does to an axis."""

MILLI_RPM_PER_RAD_S = 60e3 / (2 * math.pi)

_INT32_MAX = 0x7FFF_FFFF


def velocity_to_wire(velocity_rad_s: float) -> int:
    """Motor velocity, rad/s, as 0.001 rpm, held within int32.

    Raises
    ------
    ValueError
        If the velocity is not a finite number.
    """
    if not math.isfinite(velocity_rad_s):
        msg = f"velocity must be a finite number of rad/s, not {velocity_rad_s}"
        raise ValueError(msg)
    return max(-_INT32_MAX, min(_INT32_MAX, round(velocity_rad_s * MILLI_RPM_PER_RAD_S)))


def wrap_int32(value: int) -> int:
    """An encoder counter's value after its 32 bits have wrapped."""
    return ((value + 0x8000_0000) & 0xFFFF_FFFF) - 0x8000_0000


def mapping_entry(index: int, subindex: int, bits: int) -> int:
    """One entry of a PDO mapping: object and length."""
    return index << 16 | subindex << 8 | bits


# ---------------------------------------------------------------- the drive's state machine
class State(IntEnum):
    """States of one axis; the value is what the statusword shows under :func:`state_of`'s mask."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


FAULT_STATES = frozenset({State.FAULT, State.FAULT_REACTION_ACTIVE})
POWERED_STATES = frozenset(
    {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE}
)
"""States in which the motor has current."""

CW_DISABLE_VOLTAGE = 0x00
CW_SHUTDOWN = 0x06
CW_SWITCH_ON = 0x07
CW_ENABLE_OPERATION = 0x0F
CW_FAULT_RESET = 0x80
CW_HALT = 0x0100
"""Profile velocity mode: slow down to a stop and stay enabled."""

SW_VOLTAGE_ENABLED = 0x0010
SW_REMOTE = 0x0200
SW_TARGET_REACHED = 0x0400
"""Profile velocity mode: the demand is the target."""
SW_INTERNAL_LIMIT = 0x0800
"""The drive holds the axis back: at a software position limit, for one."""
SW_SPEED_ZERO = 0x1000
"""Profile velocity mode."""
SW_FOLLOWS_COMMAND = 0x1000
"""Cyclic synchronous modes: the axis follows its target."""

_QUICK_STOP_BIT_IS_FREE = frozenset(
    {State.NOT_READY, State.SWITCH_ON_DISABLED, State.FAULT_REACTION_ACTIVE, State.FAULT}
)
_STATE_MASKS = tuple((state, 0x4F if state in _QUICK_STOP_BIT_IS_FREE else 0x6F) for state in State)


def state_of(statusword: int) -> State | None:
    """The state that a statusword shows; None for a pattern that CiA 402 does not define."""
    return next((state for state, mask in _STATE_MASKS if statusword & mask == state), None)


def state_name(statusword: int) -> str:
    """The state for people: ``operation enabled``."""
    state = state_of(statusword)
    return "undefined state" if state is None else state.name.lower().replace("_", " ")


# ---------------------------------------------------------------- emergency messages
EMCY_NO_ERROR = 0x0000
EMCY_HEARTBEAT_LOST = 0x8130
EMCY_PDO_TOO_SHORT = 0x8210
ERROR_OVER_CURRENT = 0x2310
ERROR_FOLLOWING = 0x8611
ERROR_REGISTER_GENERIC = 0x01
ERROR_REGISTER_COMMUNICATION = 0x10

_ERROR_TEXTS = {
    0x0000: "no error",
    0x2310: "continuous over-current",
    0x2320: "short circuit",
    0x3210: "d.c. link over-voltage",
    0x3220: "d.c. link under-voltage",
    0x4210: "over-temperature of the drive",
    0x7300: "sensor",
    0x7305: "incremental encoder 1",
    0x7306: "incremental encoder 2",
    0x8120: "CAN error passive",
    0x8130: "heartbeat of the master lost",
    0x8140: "recovered from bus off",
    0x8210: "PDO too short",
    0x8400: "velocity control",
    0x8611: "following error",
}


def error_text(code: int) -> str:
    """An error code of 603F or EMCY for people."""
    text = _ERROR_TEXTS.get(code)
    return f"error 0x{code:04X}" + (f" ({text})" if text else "")


def encode_emcy(code: int, error_register: int, manufacturer: bytes = b"") -> bytes:
    """An emergency message; `manufacturer` holds up to five bytes of the maker's own."""
    return struct.pack("<HB5s", code, error_register, manufacturer)


def decode_emcy(data: bytes) -> tuple[int, int]:
    """Error code and error register of an emergency message.

    Raises
    ------
    ValueError
        If the message is shorter than the two fields.
    """
    if len(data) < 3:
        msg = f"an emergency message of {len(data)} bytes"
        raise ValueError(msg)
    code, register = struct.unpack_from("<HB", data)
    return code, register


# ---------------------------------------------------------------- SDO (CiA 301): eight bytes each way
SDO_HEADER = struct.Struct("<BHB4s")
SDO_ABORT = 0x80
SDO_UPLOAD = 0x40
SDO_UPLOAD_SEGMENT = 0x60
SDO_DOWNLOAD = 0x20
SDO_DOWNLOADED = 0x60
SDO_DOWNLOAD_SEGMENT = 0x00
SDO_SEGMENT_DOWNLOADED = 0x20
SDO_EXPEDITED = 0x02
SDO_SIZE_GIVEN = 0x01
SDO_TOGGLE = 0x10
SDO_LAST_SEGMENT = 0x01
SDO_SPECIFIER = 0xE0


class AbortCode(IntEnum):
    """Why an SDO transfer was given up."""

    TOGGLE_BIT = 0x0503_0000
    TIMED_OUT = 0x0504_0000
    COMMAND_SPECIFIER = 0x0504_0001
    OUT_OF_MEMORY = 0x0504_0005
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    MAPPING_TOO_LONG = 0x0604_0042
    WRONG_LENGTH = 0x0607_0010
    TOO_LONG = 0x0607_0012
    TOO_SHORT = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    INVALID_VALUE = 0x0609_0030
    DEVICE_STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


def abort_text(code: int) -> str:
    """An abort code for people."""
    try:
        name = AbortCode(code).name.lower().replace("_", " ")
    except ValueError:
        return f"SDO abort 0x{code:08X}"
    return f"SDO abort 0x{code:08X} ({name})"


@dataclass(frozen=True, slots=True)
class SdoFrame:
    """The parts of an SDO frame that all initiating services share."""

    command: int
    index: int
    subindex: int
    data: bytes


def encode_sdo(command: int, index: int, subindex: int, data: bytes = b"") -> bytes:
    """Eight bytes of an SDO: command, object, up to four bytes of data."""
    return SDO_HEADER.pack(command, index, subindex, data)


def decode_sdo(frame: bytes) -> SdoFrame:
    """Take an SDO frame apart.

    Raises
    ------
    ValueError
        If it is not eight bytes long.
    """
    if len(frame) != SDO_HEADER.size:
        msg = f"an SDO of {len(frame)} bytes"
        raise ValueError(msg)
    return SdoFrame(*SDO_HEADER.unpack(frame))


def expedited_command(service: int, length: int) -> int:
    """The command byte of an expedited transfer of 1 to 4 bytes."""
    return service | (4 - length) << 2 | SDO_EXPEDITED | SDO_SIZE_GIVEN


def expedited_data(frame: SdoFrame) -> bytes:
    """The data of an expedited transfer; all four bytes where no size is given."""
    length = 4 - (frame.command >> 2 & 3) if frame.command & SDO_SIZE_GIVEN else 4
    return frame.data[:length]


def announced_size(frame: SdoFrame) -> int | None:
    """The length in bytes that the start of a segmented transfer announces; None if it does not."""
    return int.from_bytes(frame.data, "little") if frame.command & SDO_SIZE_GIVEN else None


def encode_segment(chunk: bytes, toggle: int, *, last: bool) -> bytes:
    """One segment, up to seven bytes: of an upload, or of a download, whose request looks the same."""
    command = toggle | (7 - len(chunk)) << 1 | (SDO_LAST_SEGMENT if last else 0)
    return struct.pack("<B7s", command, chunk)


def decode_segment(frame: bytes) -> tuple[bytes, bool]:
    """Data of a segment of either direction, and whether it was the last."""
    return frame[1 : 8 - (frame[0] >> 1 & 7)], bool(frame[0] & SDO_LAST_SEGMENT)
