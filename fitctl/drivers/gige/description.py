"""The camera's GenICam description: where it says that it is, fetched and unpacked."""

from __future__ import annotations

import io
import zipfile

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.gige.protocol import MalformedPacketError, Register
from fitctl.drivers.interface import DeviceMismatch, DeviceProtocolError

_XML_BYTES_MAX = 16 << 20  # many times that of any known camera; 4 GiB would be read for hours
_MEMORY_END = 1 << 32


def download_xml(channel: ControlChannel) -> str:
    """The description from the camera's memory, by its first URL or else its second.

    Raises
    ------
    DeviceMismatch
        If the camera keeps none in its memory, or an absurd one.
    DeviceProtocolError
        If it cannot be unpacked.
    """
    urls = []
    for register in (Register.XML_URL_1, Register.XML_URL_2):
        text = channel.read_text(protocol.TextRegister(register, protocol.XML_URL_BYTES))
        urls.append(text)
        try:
            location = protocol.decode_xml_url(text)
        except MalformedPacketError:
            continue
        if not 0 < location.length <= min(_XML_BYTES_MAX, _MEMORY_END - location.address):
            continue
        data = channel.read_memory(location.address, location.length)
        return unpacked(data, channel.endpoint)
    raise channel.endpoint.error(
        DeviceMismatch,
        "a GenICam description of 1 byte to 16 MiB in the camera's memory, Local:NAME;ADDRESS;LENGTH",
        " and ".join(repr(url) for url in urls),
        "fitctl cannot read a description kept elsewhere; update the camera's firmware",
    )


def unpacked(data: bytes, endpoint: Endpoint) -> str:
    """The text of a description: most real cameras send a zip archive that holds the one file.

    Raises
    ------
    DeviceProtocolError
        If it is damaged or absurdly large.
    """
    try:
        if data.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                first = archive.infolist()[0]
                if first.file_size > _XML_BYTES_MAX:
                    msg = f"{first.file_size} bytes once unpacked"
                    raise ValueError(msg)
                data = archive.read(first)
        return data.rstrip(b"\0").decode("utf-8-sig")
    except Exception as error:  # a damaged archive can raise any of a dozen kinds
        raise endpoint.error(
            DeviceProtocolError,
            "a readable GenICam description",
            f"{type(error).__name__}: {error}",
            "update its firmware",
        ) from error
