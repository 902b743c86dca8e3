"""One entry of the catalogue: what is struck, how, in which mode, and what must come of it."""

from typing import NamedTuple

STAYED = "stays"
HOLDS = "holds"  # stays, and the star is within its requirement, by the mocks' bench
WAITS = "waits"  # stays, and reports what it waits for
SEARCHES = ("ACQUISITION",)  # the star was followed and lost


class Entry(NamedTuple):
    """One row.

    Attributes
    ----------
    struck : str
        A device as the mocks name it, a process, or another part of the instrument.
    how : str
        A row of `strikes.STRIKES`, or a fault of the mocks with its value, if it needs one.
    ends : tuple of str
        Modes in which `loop` may be then; `STAYED` is the one in which it was struck.
    says : str
        In an event, the reason of a mode change, the name of an interlock, or a reply.
    mode : str
        Of `loop`, in which it is struck; the other loops are then in the modes of their rig's home.
    within_s : float
        The promise: mode and words are there by then, stalls of the machine excepted.
    moves : str
        Why stages may move though nobody asks them to: the device does it by itself.
    rig : str
        A row of `setups.SETUPS`.
    loop : str
        Which loop `ends` and `mode` are about.
    others : tuple of (loop, end)
        What becomes of the rig's other loops: a mode, `STAYED`, `HOLDS` or `WAITS`.
    """

    struck: str
    how: str
    ends: tuple[str, ...]
    says: str = ""
    mode: str = "VERNIER"
    within_s: float = 2.0
    moves: str = ""
    rig: str = "fit-mock"
    loop: str = "right"
    others: tuple[tuple[str, str], ...] = ()

    @property
    def name(self):
        """What it is known by, in tests and in the table."""
        return f"{self.rig}: {self.struck} {self.how} in {self.mode}"

    @property
    def modes(self):
        """`ends` with names of modes only."""
        return {self.mode if end == STAYED else end for end in self.ends}
