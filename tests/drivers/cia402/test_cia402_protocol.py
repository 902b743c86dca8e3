import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State

indices = st.integers(0, 0xFFFF)
subindices = st.integers(0, 0xFF)


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY),
        (0x0250, State.SWITCH_ON_DISABLED),
        (0x0270, State.SWITCH_ON_DISABLED),
        (0x0231, State.READY_TO_SWITCH_ON),
        (0x0233, State.SWITCHED_ON),
        (0x1237, State.OPERATION_ENABLED),
        (0x0217, State.QUICK_STOP_ACTIVE),
        (0x021F, State.FAULT_REACTION_ACTIVE),
        (0x0238, State.FAULT),
        (0x0218, State.FAULT),
        (0x0005, None),
    ],
)
def test_statuswords_show_the_states_of_cia_402(statusword, state):
    assert protocol.state_of(statusword) is state


@given(st.integers(0, 0xFFFF))
def test_every_statusword_has_a_name(statusword):
    assert protocol.state_name(statusword)


@given(indices, subindices, st.binary(min_size=1, max_size=4))
def test_an_expedited_transfer_keeps_its_data(index, subindex, data):
    command = protocol.expedited_command(protocol.SDO_DOWNLOAD, len(data))
    frame = protocol.decode_sdo(protocol.encode_sdo(command, index, subindex, data))
    assert (frame.index, frame.subindex) == (index, subindex)
    assert protocol.expedited_data(frame) == data


@given(st.binary(max_size=7), st.sampled_from([0, protocol.SDO_TOGGLE]), st.booleans())
def test_a_segment_keeps_its_data(chunk, toggle, last):
    frame = protocol.encode_segment(chunk, toggle, last=last)
    assert len(frame) == 8
    assert protocol.decode_segment(frame) == (chunk, last)
    assert frame[0] & protocol.SDO_TOGGLE == toggle


@given(st.binary(max_size=12).filter(lambda data: len(data) != 8))
def test_an_sdo_is_eight_bytes_or_an_error(data):
    with pytest.raises(ValueError, match="an SDO of"):
        protocol.decode_sdo(data)


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(max_size=5))
def test_an_emergency_keeps_code_and_register(code, register, manufacturer):
    data = protocol.encode_emcy(code, register, manufacturer)
    assert len(data) == 8
    assert protocol.decode_emcy(data) == (code, register)


@given(st.integers())
def test_a_wrapped_counter_is_an_int32_and_the_same_modulo_2_to_32(value):
    wrapped = protocol.wrap_int32(value)
    assert -(2**31) <= wrapped < 2**31
    assert (wrapped - value) % 2**32 == 0


@given(st.floats(-1e12, 1e12))
def test_velocity_keeps_sign_and_scale_and_saturates(velocity_rad_s):
    wire = protocol.velocity_to_wire(velocity_rad_s)
    assert abs(wire) < 2**31
    exact = velocity_rad_s * protocol.MILLI_RPM_PER_RAD_S
    if abs(exact) < 2**31 - 1:
        assert abs(wire - exact) <= 0.5 + 1e-6
    else:
        assert wire * exact > 0


def test_one_revolution_a_second_is_sixty_thousand_on_the_wire():
    assert protocol.velocity_to_wire(2 * 3.141592653589793) == 60000


@pytest.mark.parametrize("velocity_rad_s", [float("nan"), float("inf")])
def test_a_velocity_that_is_no_number_is_refused(velocity_rad_s):
    with pytest.raises(ValueError, match="finite"):
        protocol.velocity_to_wire(velocity_rad_s)
