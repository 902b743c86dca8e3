"""The end of a step: whatever ends it early, what it moved is stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from fitctl.commissioning.outcome import StepError
from fitctl.drivers.interface import DeviceError
from fitctl.processes import signals_ignored


@contextmanager
def stopped_early(
    stop: Callable[[], None], reopen: Callable[[], object], danger: str
) -> Iterator[None]:
    """Stop a device when an error or an interrupt ends the block; a further signal does not end the stopping.

    An interrupt between a command and its answer leaves a line out of step. So if `stop` fails, it is called
    once more over a new connection.

    Parameters
    ----------
    stop : callable
        Raises DeviceError if the device did not stop.
    reopen : callable
        Connects anew.
    danger : str
        What is dangerous and what to do if the device did not stop.

    Raises
    ------
    StepError
        If the device did not stop, after an interrupt too: the step has failed then.
    """
    try:
        yield
    except BaseException as error:
        with signals_ignored():
            try:
                _stop(stop, reopen)
            except DeviceError as failed:
                causes = dict.fromkeys(filter(None, (str(error), str(failed))))
                msg = "; ".join((*causes, danger))
                raise StepError(msg, getattr(error, "figures", None)) from None
        raise


def _stop(stop: Callable[[], None], reopen: Callable[[], object]) -> None:
    try:
        stop()
    except DeviceError:
        reopen()
        stop()
