"""The instrument from Python: every step as a method, blocking or to be awaited.

Both forms work where an event loop runs already, as in Jupyter: the blocking one needs none, the other works in
a thread of its own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import msgspec

from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.logging.records import SequenceAttempt
from fitctl.sequences import steps
from fitctl.sequences.calibration import write_calibration
from fitctl.sequences.files import find_sequence
from fitctl.sequences.links import Link, SimulatedLink
from fitctl.sequences.methods import StepMethods
from fitctl.sequences.reading import load_sequence
from fitctl.sequences.runner import Runner, run_steps
from fitctl.sequences.view import Figures, SequenceError
from fitctl.supervisor.client import Client
from fitctl.supervisor.endpoints import service_folder
from fitctl.supervisor.keys import RemoteKey, read_key_of
from fitctl.supervisor.messages import AnyCommand, Reply, Status, Stop, Telemetry

NAME = "python"  # under which consoles see steps that a program runs

T = TypeVar("T")


class Instrument(StepMethods[Figures]):
    """One instrument, blocking: a method returns when its step is done, or raises.

    Leaving the ``with`` block leaves the instrument as it is: a star that is held stays held.

    Parameters
    ----------
    rig : Rig or path, optional
        By default the shipped fit-mock rig.
    simulate : bool
        On the virtual clock, in this process; otherwise the rig's running supervisor works.
    folder : path, optional
        The supervisor's socket folder, where it is not the one that the rig file says.
    remote : path, optional
        A key file, for a rig on another machine.
    seed : int
        Of a simulation.

    Raises
    ------
    ConfigError
        If the rig file or the key file cannot be used.
    ConnectionError
        If no supervisor answers.
    """

    def __init__(
        self,
        rig: Rig | Path | str | None = None,
        *,
        simulate: bool = False,
        folder: Path | str | None = None,
        remote: Path | str | None = None,
        seed: int = 0,
    ) -> None:
        self.rig = rig if isinstance(rig, Rig) else load_rig(Path(rig or default_rig_path()))
        self._runner: Runner | None = None
        self._client: Client | None = None
        self._link: Link
        if simulate:
            self.rig.mock_parts()
            self._link = SimulatedLink(self.rig, seed)
        else:
            self._client = Client(_where(self.rig, folder, remote))
            self._link = self._client
            try:
                self._client.send(Status())
            except ConnectionError:
                self._client.close()
                raise

    def __enter__(self) -> Instrument:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the connection; the instrument goes on."""
        if self._client is not None:
            self._client.close()

    def run(self, step: steps.Step) -> Figures:
        """Run one step; its figures, NaN where a value could not be had.

        Raises
        ------
        SequenceError
            If no attempt succeeds, or somebody stops it.
        ConnectionError
            If the supervisor does not answer.
        """
        self._runner = Runner(self._link, self.rig, NAME, 1)
        return _figures(self._runner, [step])[0]

    def run_sequence(self, file: Path | str) -> list[Figures]:
        """Run a sequence file, or a shipped sequence by its name; the figures of each step, as :meth:`run`.

        Raises
        ------
        ConfigError
            If the file is wrong, one line for each mistake.
        SequenceError, ConnectionError
            As :meth:`run`.
        """
        sequence = load_sequence(find_sequence(Path(file)), self.rig)
        self._runner = Runner(self._link, self.rig, sequence.name, len(sequence.steps))
        return _figures(self._runner, sequence.steps)

    @property
    def attempts(self) -> list[SequenceAttempt]:
        """Every attempt of the newest step or file, as the log has them."""
        return [] if self._runner is None else list(self._runner.attempts)

    def write_calibrations(self, folder: Path | str) -> list[Path]:
        """Write what the newest step or file has measured for the rig file; the fragments' paths.

        Raises
        ------
        ConfigError
            If that cannot be done.
        """
        measured = [] if self._runner is None else self._runner.calibrations
        return [write_calibration(each, self.rig, Path(folder)) for each in measured]

    def send(self, command: AnyCommand) -> Reply:
        """Give one command of :mod:`fitctl.supervisor.messages`."""
        return self._link.send(command)

    def telemetry(self) -> Telemetry:
        """What the instrument is doing now."""
        since_s = self._link.now_s()
        while True:
            telemetry = self._link.receive(2.0)
            if telemetry is None:
                msg = "the supervisor has been silent for 2 s; look at it, then try again"
                raise ConnectionError(msg)
            if telemetry.time_s >= since_s:
                return telemetry

    def stop(self) -> None:
        """SAFE, at once: every loop."""
        self._link.send(Stop())

    def end_step(self) -> None:
        """From another thread: end the step or the file that is running; the stages are held where they are."""
        if self._runner is not None:
            self._runner.contact.stop_wanted.set()


def _where(rig: Rig, folder: Path | str | None, remote: Path | str | None) -> Path | RemoteKey:
    if remote is not None:
        return read_key_of(rig, Path(remote))
    return service_folder(rig) if folder is None else Path(folder)


def _figures(runner: Runner, todo: Sequence[steps.Step]) -> list[Figures]:
    """Run steps; the figures of each, NaN where a value could not be had."""
    # The last attempt at a step is the one that was done.
    last = {attempt.step_number: attempt for attempt in run_steps(runner, todo)}
    found = [
        msgspec.json.decode(each.figures_json, type=dict[str, float | None])
        for each in last.values()
    ]
    return [{k: float("nan") if v is None else v for k, v in each.items()} for each in found]


class AsyncInstrument(StepMethods[Awaitable[Figures]]):
    """The same, to be awaited; cancelling a step ends it and holds the stages.

    A step that waits for another one's end has not begun: cancelled, it never does, and the other goes on.
    Takes what :class:`Instrument` takes, and is made by ``async with``.
    """

    def __init__(
        self,
        rig: Rig | Path | str | None = None,
        *,
        simulate: bool = False,
        folder: Path | str | None = None,
        remote: Path | str | None = None,
        seed: int = 0,
    ) -> None:
        self._make = lambda: Instrument(
            rig, simulate=simulate, folder=folder, remote=remote, seed=seed
        )
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="instrument")
        self._blocking: Instrument | None = None

    async def __aenter__(self) -> AsyncInstrument:
        self._blocking = await self._in_thread(self._make)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._in_thread(self._instrument.close)
        self._thread.shutdown(wait=False)

    @property
    def _instrument(self) -> Instrument:
        if self._blocking is None:
            msg = "the instrument is not open; use: async with AsyncInstrument(...) as instrument"
            raise SequenceError(msg)
        return self._blocking

    async def _in_thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    async def run(self, step: steps.Step) -> Figures:
        """Run one step, as :meth:`Instrument.run`."""
        instrument = self._instrument
        runner = Runner(instrument._link, instrument.rig, NAME, 1)  # of its own, to be ended alone
        running = self._thread.submit(_figures, runner, [step])
        ended = asyncio.wrap_future(running)
        try:
            return (await asyncio.shield(ended))[0]
        except asyncio.CancelledError:
            if not running.cancel():
                runner.contact.stop_wanted.set()
                await asyncio.wait([ended])
                ended.exception()  # it was stopped, as it was to be
            raise

    async def telemetry(self) -> Telemetry:
        """What the instrument is doing now; after the step that is running, if one is."""
        return await self._in_thread(self._instrument.telemetry)

    async def send(self, command: AnyCommand) -> Reply:
        """Give one command of :mod:`fitctl.supervisor.messages`; after the step that is running, if one is."""
        return await self._in_thread(lambda: self._instrument.send(command))
