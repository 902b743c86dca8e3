"""A simulation that writes the log that its run would have given."""

import msgspec

from fitctl.controllers.design.choose import design_for
from fitctl.daemon.run import run_info
from fitctl.logging.writer import LogWriter
from fitctl.simulation.simulation import Simulation

WALL_S = 1_795_000_000.0
NEAR_PX = (2.0, -1.0)


def designs_of(rig):
    """The designs that a rig's supervisor starts with."""
    return {name: design_for(rig, name) for name in rig.stellar_loops}


class LoggedSimulation(Simulation):
    """A run on the virtual clock, into a log.

    `change` may replace records on their way, or drop them by None; `start_s` is when the log says that the
    run began.
    """

    def __init__(
        self, rig, path, change=lambda record: record, star_offset_px=NEAR_PX, start_s=0.0
    ):
        self.change = change
        self.info = msgspec.structs.replace(
            run_info(rig, "virtual", start_s, designs_of(rig)), wall_minus_monotonic_s=WALL_S
        )
        self.go_on_in(path, rig)
        super().__init__(rig, 0, record=self.log, star_offset_px=star_offset_px)

    def go_on_in(self, path, rig=None):
        """Finish the file so far and begin another one."""
        if rig is None:
            self.writer.close()
        self.writer = LogWriter(path, (rig or self.rig).logging)
        self.writer.write(self.info, WALL_S)

    def log(self, record):
        record = self.change(record)
        if record is not None:
            self.writer.write(record, WALL_S + self.clock.now_s())
