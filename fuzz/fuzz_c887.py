"""Coverage-guided fuzzing of what parses the C-887's wire, on both sides: driver and mock.

The first byte chooses the side, the rest is what comes over the line.
"""

from __future__ import annotations

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.c887 import protocol
from fitctl.mocks.c887.controller import Controller
from fitctl.mocks.c887.platform import Platform
from fitctl.mocks.c887.server import CommandSplitter

_, _MOCKS = load_rig(default_rig_path().parent / "fit-testbed.toml").mock_parts()
assert _MOCKS.hexapod is not None
_SETTINGS = _MOCKS.hexapod.model_copy(update={"referenced": True})
_PARSERS = (
    protocol.parse_float,
    protocol.parse_error,
    protocol.parse_bits,
    protocol.parse_ready,
    protocol.parse_identity,
    lambda answer: protocol.parse_numbers(answer, protocol.AXES),
    lambda answer: protocol.parse_flags(answer, protocol.AXES),
)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris wants this name
    """Any bytes leave both sides alive, and what the mock says the driver can read."""
    if not data:
        return
    if data[0] % 2:
        _driver_reads(data[1:])
    else:
        _mock_takes(data[1:])


def _driver_reads(answer: bytes) -> None:
    for parse in _PARSERS:
        try:
            parse(answer)
        except ValueError:
            continue


def _mock_takes(data: bytes) -> None:
    now_s = 0.0
    platform = Platform(_SETTINGS, lambda: now_s)
    controller = Controller(_SETTINGS, platform)
    for command in CommandSplitter().feed(data):
        answer = controller.answer(command)
        if answer is not None and command != protocol.GET_READY:
            protocol.lines_of(answer)
        now_s += 0.5
        pose = platform.true_pose_at(now_s)
        for value, (low, high) in zip(pose, _SETTINGS.travel.ends, strict=True):
            assert low - 1e-6 <= value <= high + 1e-6


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
