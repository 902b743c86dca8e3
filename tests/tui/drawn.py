"""Panels drawn by hand: the console's state after some telemetry, and lines as plain text."""

import msgspec

from fitctl.tui.state import ConsoleState
from tests.instruments.fake_supervisor import START_S


def shown(supervisor, count=50):
    state = ConsoleState(START_S)
    for message in supervisor.messages(count):
        state.accept(message, message.time_s)
    state.now_s = state.received_s
    return state


def plain(lines):
    return ["".join(segment.text for segment in line) for line in lines]


def changed_tick(state, **fields):
    state.loop.tick = msgspec.structs.replace(state.loop.tick, **fields)
    return state.loop.tick
