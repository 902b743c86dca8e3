"""Whole sequences, run by a test's own program."""

from fitctl.sequences.contact import Contact
from fitctl.sequences.runner import Runner, run_steps

REFERENCE = {"step": "collector", "action": "reference"}
SINE = {
    "step": "collector",
    "action": "start",
    "kind": "sine",
    "amplitude_mm": 2.0,
    "frequency_hz": 0.2,
}
WAIT = {"step": "wait", "duration_s": 3.0}


def run_sequence(link, rig, sequence, *on_status):
    """Every attempt."""
    contact = Contact(link, rig, sequence.name, len(sequence.steps), *on_status)
    return run_steps(Runner(contact), sequence.steps)


def lose(link, is_lost, *, obeyed=False):
    """The next command that `is_lost` picks is not answered; whether it is obeyed all the same."""
    send, lost = link.send, []

    def sends(command):
        if lost or not is_lost(command):
            return send(command)
        lost.append(command)
        if obeyed:
            send(command)
        msg = "no answer within 2 s"
        raise ConnectionError(msg)

    link.send = sends
