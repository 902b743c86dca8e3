"""The mock drive's object dictionary on the wire, and frames that nobody should send."""

import pytest
from cia402_bus import on_drive
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.drivers.cia402 import protocol


def test_sdo_reads_writes_and_aborts():
    async def script(bus, _mock, _motors):
        await bus.ask("40 00 10 00 00000000", "43 00 10 00 92 01 ff ff")  # device type
        await bus.ask("40 18 10 04 00000000", "43 18 10 04 01 29 35 01")  # serial number
        await bus.ask("40 02 65 00 00000000", "43 02 65 00 04 01 00 00")  # modes 3 and 9
        await bus.ask("2f 60 60 00 09000000", "60 60 60 00 00 00 00 00")  # mode 9
        await bus.ask("40 61 60 00 00000000", "4f 61 60 00 09 00 00 00")  # ... is shown
        await bus.ask("22 ff 60 00 e8030000", "60 ff 60 00 00 00 00 00")  # size not given
        await bus.ask("40 99 20 00 00000000", "80 99 20 00 00 00 02 06")  # no such object
        await bus.ask("40 18 10 09 00000000", "80 18 10 09 11 00 09 06")  # no such subindex
        await bus.ask("2b 41 60 00 00000000", "80 41 60 00 02 00 01 06")  # read only
        await bus.ask("2f 40 60 00 06000000", "80 40 60 00 13 00 07 06")  # one byte of two
        await bus.ask("23 40 60 00 06000000", "80 40 60 00 12 00 07 06")  # four bytes of two
        await bus.ask("2f 60 60 00 08000000", "80 60 60 00 30 00 09 06")  # mode 8 not supported
        await bus.ask("c2 00 10 00 00000000", "80 00 10 00 01 00 04 05")  # block transfer

    on_drive(script)


def test_a_text_comes_in_segments():
    async def script(bus, _mock, _motors):
        await bus.ask("40 08 10 00 00000000", "41 08 10 00 1f 00 00 00")
        await bus.ask("60 00000000000000", "00 46 49 54 20 74 77 6f")  # FIT two
        await bus.ask("70 00000000000000", "10 2d 61 78 69 73 20 73")  # -axis s
        await bus.ask("60 00000000000000", "00 65 72 76 6f 20 64 72")  # ervo dr
        await bus.ask("70 00000000000000", "10 69 76 65 20 28 6d 6f")  # ive (mo
        await bus.ask("60 00000000000000", "09 63 6b 29 00 00 00 00")  # ck)
        await bus.ask("40 08 10 00 00000000", "41 08 10 00 1f 00 00 00")
        await bus.ask("70 00000000000000", "80 08 10 00 00 00 03 05")  # toggle bit

    on_drive(script)


def test_a_download_may_come_in_segments():
    async def script(bus, mock, _motors):
        await bus.ask("21 ff 60 00 04000000", "60 ff 60 00 00 00 00 00")
        await bus.ask("07 e8030000 000000", "20 00 00 00 00 00 00 00")  # all four, the last segment
        assert mock.axes[0].target_velocity == 1000
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")  # length not told
        await bus.ask("0a d0070000 000000", "20 00 00 00 00 00 00 00")  # two of four
        await bus.ask("1b 0000 0000000000", "30 00 00 00 00 00 00 00")
        assert mock.axes[0].target_velocity == 0x07D0
        await bus.ask("21 ff 60 00 05000000", "80 ff 60 00 12 00 07 06")  # five bytes of four
        await bus.ask("21 41 60 00 02000000", "80 41 60 00 02 00 01 06")  # read only
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")
        await bus.ask("00 01020304050607", "80 ff 60 00 12 00 07 06")  # seven bytes and more
        await bus.ask("01 01020304050607", "80 ff 60 00 01 00 04 05")  # the transfer is over
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")
        await bus.ask("17 e8030000 000000", "80 ff 60 00 00 00 03 05")  # toggle bit
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")
        bus.send(0x601, "80 ff 60 00 00 00 04 05")  # the client gives up
        await bus.ask("07 e8030000 000000", "80 ff 60 00 01 00 04 05")

    on_drive(script)


def test_a_mapping_is_guarded():
    async def script(bus, _mock, _motors):
        await bus.ask("23 00 1a 01 10 00 08 10", "80 00 1a 01 41 00 04 06")  # 1008 is not mappable
        await bus.ask("23 00 1a 01 10 00 64 60", "80 00 1a 01 41 00 04 06")  # 6064 has 32 bits
        await bus.map_pdos()
        await bus.ask("2f 00 1a 00 00000000", "80 00 1a 00 22 00 00 08")  # in service
        await bus.ask("23 02 18 01 01060000", "80 02 18 01 30 00 09 06")  # SDO's identifier
        await bus.ask("23 02 18 01 81030020", "80 02 18 01 30 00 09 06")  # a 29-bit identifier
        await bus.ask("2f 02 18 02 f1000000", "80 02 18 02 30 00 09 06")  # type 241
        await bus.ask("2f 02 14 02 fd000000", "80 02 14 02 30 00 09 06")  # 253, of an RPDO

    on_drive(script)


WRITTEN = (
    *(0x1003, 0x1016, 0x1017, 0x1400, 0x1600, 0x1800, 0x1A00),
    *(0x6007, 0x6040, 0x605A, 0x607D, 0x6083, 0x6085, 0x60FF, 0x6860),
)
random_frames = st.tuples(
    st.sampled_from([0x601, 0x601, 0x601, 0x000, 0x080, 0x201, 0x301, 0x77F, 0x123]),
    st.binary(max_size=8)
    | st.builds(
        protocol.encode_sdo,
        st.sampled_from([0x00, 0x01, 0x17, 0x20, 0x21, 0x23, 0x2B, 0x2F, 0x40, 0x60, 0x70, 0x80]),
        st.sampled_from(WRITTEN),
        st.integers(0, 3),
        st.binary(max_size=4),
    ),
)


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(st.lists(random_frames, max_size=30))
def test_no_frame_breaks_the_drive(frames):
    async def script(bus, _mock, _motors):
        for can_id, data in frames:
            bus.send(can_id, data.hex())
        bus.send(0x000, "81 00")
        await bus.see(0x701, "00")
        await bus.ask("40 64 68 00 00000000", "43 64 68 00 00 00 00 00")

    on_drive(script)
