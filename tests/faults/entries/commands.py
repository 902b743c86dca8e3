"""Commands that are none, and too many of them: each is refused in words, and the star is held."""

import math

import msgspec
import zmq

from fitctl.messages.commands import Acquire, Experiment, Reply, Reset, SetTarget, Standby, Status
from fitctl.messages.endpoints import COMMAND_SOCKET
from fitctl.model.drives import Drive

from .entry import STAYED, Entry

FLOOD = 10_000
ALONE = 200
FASTER = 4  # a flood is answered eight a round; one by one, there is a round for each
ANSWERED = f"{FLOOD} answers, at least {FASTER} times as fast as one by one"
ANSWER_MS = 1000
BATCH = 500


def packed(**fields):
    return msgspec.msgpack.encode(fields)


def wild():
    drive = Drive(
        channel="fsm_az", shape="sine", amplitude=math.nan, frequency_hz=1.0, duration_s=1.0
    )
    return Experiment(name="wild", drives=[drive])


encode = msgspec.msgpack.encode
# What is sent, frame by frame, and what the refusal says; nothing for what is not answered.
SENT = {
    "empty": ((b"tag", b""), "not a command"),
    "noise": ((b"tag", bytes(range(256))), "not a command"),
    "JSON": ((b"tag", b'{"type": "Stop"}'), "not a command"),
    "of an unknown kind": ((b"tag", packed(type="Explode")), "not a command"),
    "without a kind": ((b"tag", packed(loop="right")), "not a command"),
    "with an unknown field": ((b"tag", packed(type="Release", force=True)), "not a command"),
    "with a word for a number": (
        (b"tag", packed(type="SetTarget", az_px="left", el_px=1.0)), "not a command"),
    "nested a thousand deep": ((b"tag", b"\x91" * 1000 + b"\x01"), "not a command"),
    "of another version": ((b"tag", packed(type="Release", version=99)), "speaks version"),
    "to a loop that is none": ((b"tag", encode(Acquire(loop="left"))), "no loop is named left"),
    "with a target that is no number": (
        (b"tag", encode(SetTarget(az_px=math.nan, el_px=19.5))), "target"),
    "with a target outside the picture": (
        (b"tag", encode(SetTarget(az_px=1e9, el_px=19.5))), "target"),
    "with a motion that is no number": ((b"tag", encode(wild())), "experiment"),
    "that resets nothing": ((b"tag", encode(Reset(name="moon"))), "no interlock is named moon"),
    "in the wrong mode": ((b"tag", encode(Standby())), "standby is not available in VERNIER"),
    "larger than any": ((b"tag", b"\x00" * 100_000), ""),
    "without a tag": ((b"",), ""),
    "in five frames": ((b"a", b"b", b"c", b"d", b"e"), ""),
}  # fmt: skip


def answers(sockets, frames, times=1, ahead=BATCH):
    """Send frames so many times from one socket, so many ahead; the texts that come back."""
    context = zmq.Context()
    try:
        with context.socket(zmq.DEALER) as dealer:
            dealer.setsockopt(zmq.LINGER, 0)
            dealer.connect(f"ipc://{sockets / COMMAND_SOCKET}")
            for _ in range(0, times, ahead):
                sent = min(times, ahead)
                for _ in range(sent):
                    dealer.send_multipart(frames)
                for _ in range(sent):
                    if not dealer.poll(ANSWER_MS):
                        return
                    yield msgspec.msgpack.decode(dealer.recv_multipart()[-1], type=Reply).text
    finally:
        context.term()


FLOODED = (b"tag", encode(Status()))

ENTRIES = (
    *(
        Entry("command", how, (STAYED,), said, within_s=2.0)
        for how, (_, said) in SENT.items()
    ),
    Entry("command", f"sent {FLOOD} times at once", (STAYED,), ANSWERED, within_s=30.0),
)  # fmt: skip
