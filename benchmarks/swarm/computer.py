"""The computer that the supervisor runs on: its wall clock, and the disk of its log.

:func:`installed` has :class:`fitctl.daemon.machine.Machine` measure these in place of the real ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from benchmarks.swarm.threads import VirtualTime
from fitctl.daemon import machine
from fitctl.supervisor.supervisor import Supervisor

_FREE_BYTES = 10**12
_SAME_S = 1e-6


class Computer:
    """What people and programs do to it besides fitctl.

    Attributes
    ----------
    wall_s : float
        By how much its wall clock has been set forward.
    disk_is_full : bool
    """

    def __init__(self) -> None:
        self.wall_s = 0.0
        self.disk_is_full = False

    def machine_of(
        self,
        supervisor: Supervisor,
        backlog: Callable[[], float],
        violated: Callable[[str, str], None],
    ) -> machine.Machine:
        """What measures this computer for a supervisor; each step of the clock must be measured as it was."""
        known_s = self.wall_s

        def measured(name: str, value: float) -> None:
            nonlocal known_s
            supervisor.report_quantity(name, value)
            if name == "clock_step_s":
                known_s += value
                if abs(known_s - self.wall_s) > _SAME_S:
                    violated(
                        "steps of the clock are measured",
                        f"{known_s:.3f} s in all, not {self.wall_s:.3f} s",
                    )

        return machine.Machine(Path(), backlog, measured, supervisor.report_event)


@contextmanager
def installed(time: VirtualTime, computer: Computer) -> Iterator[None]:
    """The supervisor's process measures this computer meanwhile."""
    stand_ins = {
        "time": SimpleNamespace(monotonic=time.now_s),
        "free_bytes": lambda _folder: 0 if computer.disk_is_full else _FREE_BYTES,
        "wall_minus_monotonic_s": partial(
            machine.wall_minus_monotonic_s, lambda: time.now_s() + computer.wall_s, time.now_s
        ),
    }
    with ExitStack() as stack:
        for name, stand_in in stand_ins.items():
            stack.enter_context(patch.object(machine, name, stand_in))
        yield
