"""Whole sequences, run by a test's own program."""

from fitctl.sequences.contact import Contact
from fitctl.sequences.runner import Runner, run_steps


def run_sequence(link, rig, sequence, *on_status):
    """Every attempt."""
    contact = Contact(link, rig, sequence.name, len(sequence.steps), *on_status)
    return run_steps(Runner(contact), sequence.steps)
