"""Logs to report on, from the virtual clock, and ticks made by hand."""

import numpy as np
from samples.logged_simulation import designs_of

from fitctl.daemon.run import run_info
from fitctl.logging.records import FrameRecord, RecorderStatus
from fitctl.logging.writer import LogWriter
from fitctl.messages.commands import SetTarget
from fitctl.messages.modes import Mode
from fitctl.report.gather import TICK_FIELDS
from fitctl.simulation.simulation import Simulation

NEARBY_PX = np.array([5.0, -3.0])
PERIOD_S = 0.02


def record(rig, path, course, seed=1):
    """What a recorder would have written of a simulated course, without the frames."""
    info = run_info(rig, "simulated", now_s=0.0, designs=designs_of(rig))
    with LogWriter(path, rig.logging) as log:

        def take(what):
            if not isinstance(what, FrameRecord):
                log.write(what, simulation.clock.now_s() + info.wall_minus_monotonic_s)

        log.write(info, info.wall_minus_monotonic_s)
        simulation = Simulation(rig, seed=seed, star_offset_px=NEARBY_PX, record=take)
        course(simulation)
        now_s = simulation.clock.now_s()
        take(
            RecorderStatus(
                time_s=now_s, path=path.name, records=log.records, lost=3, bytes_written=1
            )
        )
    return simulation


def held_and_jogged(simulation):
    """Acquired and held, and the target goes up by a pixel and back."""
    simulation.acquire()
    simulation.run(45.0)
    target = simulation.rig.loops["right"].target_px
    for px in (1.0, 0.0):
        simulation.command(SetTarget(loop="right", az_px=target.az + px, el_px=target.el))
        simulation.run(12.0)


def ticks_of(frames, mode=Mode.VERNIER, **columns):
    """Ticks of a loop that does nothing, 50 a second, but for the columns given."""
    time_s = PERIOD_S * np.arange(frames)
    made = {name: np.zeros(frames, dtype) for name, dtype in TICK_FIELDS.items()}
    made |= {
        "time_s": time_s,
        "mid_exposure_s": time_s - 0.035,
        "number": np.arange(frames),
        "mode_number": np.full(frames, mode, np.int8),
        "star_visible": np.ones(frames, bool),
    }
    return made | columns
