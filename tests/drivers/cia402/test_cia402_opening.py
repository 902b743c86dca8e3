"""CAN adapters that cannot be opened: whatever python-can raises becomes the driver's own error."""

import can
import pytest

from fitctl.drivers.cia402.link import CanLink
from fitctl.drivers.interface import DeviceUnreachable


@pytest.mark.parametrize(
    "error",
    [
        NameError("name 'canGetNumberOfChannels' is not defined"),
        TypeError("__init__() missing 1 required positional argument: 'port'"),
        can.CanInitializationError("no such adapter"),
        AttributeError(),
    ],
)
def test_an_adapter_that_cannot_be_opened_is_unreachable_with_its_own_reason(
    siderostat, monkeypatch, error
):
    def refuse(**_):
        raise error

    monkeypatch.setattr(can, "Bus", refuse)
    device = siderostat.device.model_copy(update={"interface": "kvaser", "channel": "0"})

    with pytest.raises(DeviceUnreachable) as caught:
        CanLink(device)

    assert f"expected an open CAN bus, got {type(error).__name__}: {error}" in str(caught.value)
    assert "kvaser 0" in str(caught.value)
