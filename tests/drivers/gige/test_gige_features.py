"""The description in the camera's memory, when the camera is not to be trusted."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from gige_served import camera_settings

from fitctl.drivers.gige import protocol as p
from fitctl.drivers.gige.features import Features, unpacked
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.interface import DeviceMismatch, DeviceProtocolError
from fitctl.mocks.gige import memory

XML_ADDRESS = 0x10000


class Memory(ControlChannel):
    """A camera's memory without the network: one URL, and what it points to."""

    def __init__(self, url: str, content: bytes = b"") -> None:
        super().__init__("127.0.0.1", p.GVCP_PORT, timeout_s=0.1)
        self.close()
        self._url = url
        self._content = content

    def read_text(self, register: p.TextRegister) -> str:
        return self._url if register.address == p.Register.XML_URL_1 else ""

    def read_memory(self, address: int, length: int) -> bytes:
        assert (address, length) == (XML_ADDRESS, len(self._content)), "not to be read"
        return self._content


@pytest.mark.parametrize(
    "place", ["10000;FFFFFFFF", "10000;1000001", "10000;0", "FFFFFFFF;2", "123456789;10"]
)
def test_a_description_of_an_absurd_size_or_place_is_refused_unread(place: str) -> None:
    with pytest.raises(DeviceMismatch, match=r"1 byte to 16 MiB.*" + place):
        Features(Memory(f"Local:camera.zip;{place}"))


def archive() -> bytearray:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as writer:
        # Its date is fixed: the bytes are in the tests' names, which every worker has to find the same.
        writer.writestr(zipfile.ZipInfo("a.xml"), "<x>" * 100, zipfile.ZIP_DEFLATED)
    return bytearray(buffer.getvalue())


def changed(offset: int, value: int) -> bytes:
    """An archive with one byte changed: in its directory if `offset` is counted from there."""
    data = archive()
    data[offset] = value
    return bytes(data)


DATA = 30 + len("a.xml")  # after the local header
DIRECTORY = bytes(archive()).index(b"PK\x01\x02")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (changed(DATA, 0xFF), "invalid block type"),
        (changed(DIRECTORY + 8, 0x01), "encrypted"),
        (changed(DIRECTORY + 10, 99), "compression method is not supported"),
        (b"PK but no archive", "not a zip file"),
        (b"\xff\xfe", "can't decode byte"),
    ],
    # Not the bytes, which hold the time at which the archive was made.
    ids=lambda value: value if isinstance(value, str) else "content",
)
def test_a_description_that_cannot_be_unpacked_is_named(content: bytes, why: str) -> None:
    with pytest.raises(DeviceProtocolError, match=why):
        Features(Memory(f"Local:camera.zip;{XML_ADDRESS:X};{len(content):X}", content))


def bomb(size: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as writer:
        writer.writestr("a.xml", bytes(size))
    return buffer.getvalue()


def lying(size: int) -> bytes:
    """An archive whose directory gives its file 100 bytes."""
    content = bomb(size)
    return content.replace(size.to_bytes(4, "little"), (100).to_bytes(4, "little"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("archive", "why"),
    [(bomb, "314572800 bytes once unpacked"), (lying, "Bad CRC-32")],
)
def test_an_archive_that_unpacks_to_an_absurd_size_takes_no_memory(
    archive: Callable[[int], bytes], why: str
) -> None:
    content = archive(300 << 20)
    assert len(content) < 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(DeviceProtocolError, match=why):
            Features(Memory(f"Local:camera.zip;{XML_ADDRESS:X};{len(content):X}", content))
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


DESCRIPTION = Path(memory.__file__).with_name("fit_camera.xml").read_text()
EXPANDING = "".join(f'<!ENTITY e{n} "{10 * f"&e{n - 1};"}">' for n in range(1, 9))


@pytest.mark.parametrize(
    "declaration",
    [
        f'[<!ENTITY e0 "{100 * "x"}">{EXPANDING}]',
        '[<!ENTITY e8 SYSTEM "file:///etc/hostname">]',
        'SYSTEM "http://127.0.0.1:9/camera.dtd"',
        '[<!ENTITY e8 "harmless">]',
    ],
    ids=["expanding entities", "a file", "another host", "harmless"],
)
def test_a_description_that_declares_a_document_type_is_refused(declaration: str) -> None:
    head, rest = DESCRIPTION.split("?>", 1)
    hostile = f"{head}?><!DOCTYPE RegisterDescription {declaration}>" + rest.replace(
        'ToolTip="Mock pointing camera"', 'ToolTip="&e8;"'
    )
    content = hostile.encode()
    with pytest.raises(DeviceProtocolError, match="declares a document type"):
        Features(Memory(f"Local:camera.xml;{XML_ADDRESS:X};{len(content):X}", content))


def test_a_description_may_have_a_byte_order_mark_and_zeros_after_it() -> None:
    assert unpacked(b"\xef\xbb\xbf<x/>\0\0\0", "test") == "<x/>"


AUTOMATIC = ("ExposureAuto", "GainAuto", "AcquisitionFrameRateAuto", "GevGVSPExtendedIDMode")
SWITCHES = {  # and how each is to be
    "AcquisitionFrameRateEnable": True,
    "AcquisitionFrameRateEnabled": True,
    "ChunkModeActive": False,
}
ADDRESSES = {name: 0xB000 + 4 * at for at, name in enumerate((*AUTOMATIC, *SWITCHES))}


def richer_description() -> str:
    """The mock's, with every feature that could change a picture by itself."""
    nodes = [
        f'<Enumeration Name="{name}"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>'
        f'<EnumEntry Name="Continuous"><Value>2</Value></EnumEntry><pValue>{name}Reg</pValue></Enumeration>'
        for name in AUTOMATIC
    ]
    nodes += [
        f'<Boolean Name="{name}"><pValue>{name}Reg</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>'
        for name in SWITCHES
    ]
    nodes += [
        f'<IntReg Name="{name}Reg"><Address>{address}</Address><Length>4</Length><AccessMode>RW</AccessMode>'
        "<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
        for name, address in ADDRESSES.items()
    ]
    return DESCRIPTION.replace("</RegisterDescription>", "".join(nodes) + "</RegisterDescription>")


class Registers(Memory):
    """A camera's memory that keeps what is written to it."""

    def __init__(self, description: str, words: dict[int, int]) -> None:
        content = description.encode()
        super().__init__(f"Local:camera.xml;{XML_ADDRESS:X};{len(content):X}", content)
        self.words = words

    def read_register(self, address: int) -> int:
        return self.words.get(address, 0)

    def write_register(self, address: int, value: int) -> None:
        self.words[address] = value

    def read_memory(self, address: int, length: int) -> bytes:
        if address == XML_ADDRESS:
            return super().read_memory(address, length)
        return p.encode_words(*(self.read_register(address + at) for at in range(0, length, 4)))

    def write_memory(self, address: int, data: bytes) -> None:
        for at in range(0, len(data), 4):
            self.write_register(address + at, int.from_bytes(data[at : at + 4], "big"))


def test_a_feature_whose_access_cannot_be_evaluated_is_named() -> None:
    auto = '<Enumeration Name="GainAuto">'
    text = richer_description().replace(auto, f"{auto}<pIsLocked>Locked</pIsLocked>")
    locked = '<IntSwissKnife Name="Locked"><Formula>1 / 0</Formula></IntSwissKnife>'
    text = text.replace("</RegisterDescription>", f"{locked}</RegisterDescription>")
    with pytest.raises(DeviceMismatch, match="GainAuto"):
        Features(Registers(text, {})).configure(camera_settings())


def test_nothing_of_a_camera_stays_automatic() -> None:
    settings = camera_settings()
    pixels = settings.width_px * settings.height_px
    # The largest width and height, the bytes of a picture, and an exposure.
    words = {0xA028: 640, 0xA02C: 480, 0xA014: 2 * pixels}
    words |= dict(
        zip((0xA030, 0xA034), struct.unpack(">II", struct.pack(">d", 1000.0)), strict=True)
    )
    words |= dict.fromkeys(ADDRESSES.values(), 2)
    words |= {ADDRESSES[name]: not wanted for name, wanted in SWITCHES.items()}
    camera = Registers(richer_description(), words)
    Features(camera).configure(settings)
    assert {name: camera.words[ADDRESSES[name]] for name in AUTOMATIC} == dict.fromkeys(
        AUTOMATIC, 0
    )
    assert {name: camera.words[ADDRESSES[name]] for name in SWITCHES} == SWITCHES
