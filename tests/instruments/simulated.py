"""Small words for statements about an instrument on the virtual clock."""

from concurrent.futures import Future

from fitctl.logging.records import Event
from fitctl.simulation.devices import InlineExecutor

NEAR = {"star_offset_px": (10.0, -6.0)}
SOON = "loops.right.coarse.reach_fraction=0.7"  # seconds less in COARSE
AS_SHIPPED = "loops.right.coarse.reach_fraction=0.05"  # the mirror is near its bias in VERNIER
TWO_STARS = (
    "plant.loops.right.spots=[{name='a', offset_px={az=0.0, el=0.0}, flux_dn=30000.0, diameter_px=3.0}, "
    "{name='b', offset_px={az=-9.0, el=5.0}, flux_dn=24000.0, diameter_px=3.0}]"
)


def until(simulation, mode, limit_s=30.0):
    """Run until the loop is in `mode`; fails after `limit_s` of virtual time."""
    end_s = simulation.clock.now_s() + limit_s
    loop = simulation.supervisor.loops["right"]
    while loop.mode is not mode:
        assert simulation.clock.now_s() < end_s, f"still {loop.mode.name}, wanted {mode.name}"
        simulation.run(0.02)
    return simulation


def darken(simulation, factor=0.0):
    """All spots fade to `factor` of their light."""
    simulation.camera._scene._flux_dn = simulation.camera._scene._flux_dn * factor


def mode_of(simulation):
    return simulation.supervisor.loops["right"].mode


def events_of(simulation):
    return [record for record in simulation.records if isinstance(record, Event)]


def failing(error):
    """A function that fails, whatever it is given."""

    def fail(*_args, **_kwargs):
        raise error

    return fail


class SlowExecutor(InlineExecutor):
    """Device work is done at once, but that is known only once `finish` was called."""

    def __init__(self):
        self._waiting = []

    def submit(self, fn, /, *args, **kwargs):
        done, shown = super().submit(fn, *args, **kwargs), Future()
        self._waiting.append((done, shown))
        return shown

    def finish(self):
        for done, shown in self._waiting:
            if not shown.set_running_or_notify_cancel():
                continue
            if (error := done.exception()) is not None:
                shown.set_exception(error)
            else:
                shown.set_result(done.result())
        self._waiting.clear()
