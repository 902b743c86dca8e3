"""A voltmeter as tickit has it; named in the configuration that `foreign.tickit` writes."""

import pydantic.v1.dataclasses
from tickit.adapters.io.tcp_io import TcpIo
from tickit.adapters.specifications import RegexCommand
from tickit.adapters.tcp import CommandAdapter
from tickit.core.adapter import AdapterContainer
from tickit.core.components.component import Component, ComponentConfig
from tickit.core.components.device_component import DeviceComponent
from tickit.devices.iobox import IoBoxDevice

from benchmarks.foreign import ANSWER, QUESTION


class Adapter(CommandAdapter):
    """One question."""

    @RegexCommand(QUESTION.replace(b"?", rb"\?"))
    async def voltage(self) -> bytes:
        """A reading."""
        return ANSWER


@pydantic.v1.dataclasses.dataclass
class Voltmeter(ComponentConfig):
    """Its configuration."""

    port: int

    def __call__(self) -> Component:
        """The device with its adapter."""
        adapters = [AdapterContainer(Adapter(), TcpIo("127.0.0.1", self.port))]
        return DeviceComponent(name=self.name, device=IoBoxDevice(), adapters=adapters)
