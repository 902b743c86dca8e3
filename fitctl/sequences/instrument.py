"""The instrument from Python: every step as a method, blocking or to be awaited.

Both forms work where an event loop runs already, as in Jupyter: the blocking one needs none, the other works in
a thread of its own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from math import nan
from pathlib import Path
from typing import TypeVar

import msgspec

from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.logging.records import SequenceAttempt
from fitctl.messages.client import Client
from fitctl.messages.command_table import ROWS, as_command
from fitctl.messages.commands import AnyCommand, Reply, Status, Stop
from fitctl.messages.endpoints import service_folder
from fitctl.messages.keys import RemoteKey, read_key_of
from fitctl.messages.running import only_running_rig, rig_of_environment
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.waiting import wait_for_outcomes
from fitctl.sequences import steps
from fitctl.sequences.behaviours.calibration import write_calibration
from fitctl.sequences.contact import Contact
from fitctl.sequences.files import find_sequence
from fitctl.sequences.links import Link, SimulatedLink
from fitctl.sequences.methods import StepMethods
from fitctl.sequences.reading import load_sequence
from fitctl.sequences.runner import Runner, run_steps
from fitctl.sequences.view import Figures, SequenceError

NAME = "python"  # under which consoles see steps that a program runs
_NONE_RUNS = (
    "you have no supervisor running on this machine; start one with fitctl demo or fitctl run, name a rig "
    "file, or try Instrument(simulate=True)"
)

T = TypeVar("T")


def _figures_of(attempt: SequenceAttempt) -> dict[str, float | None]:
    return msgspec.json.decode(attempt.figures_json, type=dict[str, float | None])


class Instrument(StepMethods[Figures]):
    """One instrument, blocking: a method returns when its step is done, or raises.

    Each step of a sequence is a method with the step's keys as arguments, such as :meth:`acquire` and
    :meth:`hold`. It returns the figures of the step: a dict of numbers with units in their names (``_px`` on
    the camera, ``_sky_arcsec`` on the sky, ``_s``), NaN where a value is unknown. For a step on several
    loops, each name begins with the loop's name and ``_``.

    Leaving the ``with`` block leaves the instrument as it is: a star that is held stays held.

    Parameters
    ----------
    rig : Rig or path, optional
        By default the rig file that the environment variable FITCTL_RIG names, or else the rig of your only
        running supervisor on this machine. With `simulate`, `folder` or `remote`, the second default is the
        shipped fit-mock rig.
    simulate : bool
        Simulate the rig on the virtual clock in this process, without a supervisor.
    folder : path, optional
        The supervisor's socket folder, if it differs from the one in the rig file.
    remote : path, optional
        A key file, for a rig on another machine.
    seed : int
        Seed of the simulation.

    Raises
    ------
    ConfigError
        If the rig file or the key file cannot be used, or no rig is named and several supervisors run.
    ConnectionError
        If no supervisor answers.

    Examples
    --------
    >>> with Instrument(simulate=True, seed=1) as instrument:
    ...     acquired = instrument.acquire()
    ...     held = instrument.hold(5.0, settle_s=5.0)
    >>> sorted(held)  # doctest: +NORMALIZE_WHITESPACE
    ['frames_seen', 'limit_px', 'rms_az_px', 'rms_az_sky_arcsec', 'rms_el_px',
     'rms_el_sky_arcsec']
    >>> held["rms_az_px"] < held["limit_px"]
    True
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
        is_found = not simulate and folder is None and remote is None
        self.rig = rig if isinstance(rig, Rig) else _load(rig, the_running=is_found)
        self._runner: Runner | None = None
        self._link: Link
        if simulate:
            self.rig.mock_parts()
            self._link = SimulatedLink(self.rig, seed)
        else:
            self._link = Client(_where(self.rig, folder, remote))
            try:
                self._link.send(Status())
            except ConnectionError:
                self._link.close()
                raise

    def __enter__(self) -> Instrument:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; the instrument continues."""
        self._link.close()

    def run(self, step: steps.Step) -> Figures:
        """Run one step.

        Parameters
        ----------
        step : Step
            One of :mod:`fitctl.sequences.steps`, such as ``steps.Hold(duration_s=30.0)``.

        Returns
        -------
        dict of str to float
            The figures of the step.

        Raises
        ------
        SequenceError
            If no attempt succeeds, or somebody stops it.
        ConnectionError
            If the supervisor does not answer.
        """
        return self._run(self._runner_of(NAME, [step]), [step])[0]

    def run_sequence(self, file: Path | str) -> list[Figures]:
        """Run a sequence file, or a shipped sequence by its name.

        Parameters
        ----------
        file : path
            TOML or YAML, or the bare name of a shipped sequence.

        Returns
        -------
        list of dict of str to float
            The figures of each step.

        Raises
        ------
        ConfigError
            If the file is wrong, one line for each mistake.
        SequenceError, ConnectionError
            As :meth:`run`.
        """
        sequence = self._sequence(file)
        return self._run(self._runner_of(sequence.name, sequence.steps), sequence.steps)

    def _sequence(self, file: Path | str) -> steps.Sequence:
        return load_sequence(find_sequence(Path(file)), self.rig)

    def _runner_of(self, name: str, todo: Sequence[steps.Step]) -> Runner:
        # A program's steps come one by one: what the collector does goes on between them.
        contact = Contact(self._link, self.rig, name, len(todo))
        return Runner(contact, motion_goes_on=name == NAME)

    def _run(self, runner: Runner, todo: Sequence[steps.Step]) -> list[Figures]:
        """Run steps; return the figures of each, NaN where a value is missing."""
        self._runner = runner
        # The last attempt at a step is the one that was done; a step may be for several loops.
        last = {(each.step_number, each.loop): each for each in run_steps(runner, todo)}
        loops: dict[int, list[SequenceAttempt]] = {}
        for (number, _), attempt in last.items():
            loops.setdefault(number, []).append(attempt)
        return [
            {
                (f"{each.loop}_{key}" if len(attempts) > 1 else key): nan
                if value is None
                else value
                for each in attempts
                for key, value in _figures_of(each).items()
            }
            for attempts in loops.values()
        ]

    @property
    def attempts(self) -> list[SequenceAttempt]:
        """Every attempt of the newest step or file, as :class:`fitctl.logging.records.SequenceAttempt`."""
        return [] if self._runner is None else list(self._runner.attempts)

    def write_calibrations(self, folder: Path | str) -> list[Path]:
        """Write what the newest step or file has measured for the rig file.

        Parameters
        ----------
        folder : path
            An existing folder.

        Returns
        -------
        list of Path
            The fragments, for the ``include`` list of the rig file.

        Raises
        ------
        ConfigError
            If that cannot be done.
        """
        measured = [] if self._runner is None else self._runner.calibrations
        return [write_calibration(each, self.rig, Path(folder)) for each in measured]

    def send(self, command: AnyCommand | str, loop: str = "") -> Reply:
        """Send one command and return the reply; from any thread.

        Parameters
        ----------
        command : str or AnyCommand
            The words that follow ``fitctl send`` in a shell, such as ``"stop"`` or ``"target 24 19.5"``, or a
            message of :mod:`fitctl.messages.commands`.
        loop : str, optional
            With words: the loop that the command is for. All loops without it.

        Returns
        -------
        Reply
            ``accepted``, and ``text`` with the reason if the supervisor refused the command.

        Raises
        ------
        ConfigError
            If the words are no command, or its values are not what it needs.
        TypeError
            If `command` is neither words nor a message.
        ConnectionError
            If the supervisor does not answer.

        Examples
        --------
        >>> with Instrument(simulate=True) as instrument:
        ...     instrument.send("standby").accepted
        True
        """
        return self._link.send(as_command(command, loop))

    def send_and_wait(
        self, command: AnyCommand | str, timeout_s: float | None = None, loop: str = ""
    ) -> None:
        """Send a command and wait until it is done; not from the thread of a step.

        Parameters
        ----------
        command : str or AnyCommand
            As :meth:`send`.
        timeout_s : float, optional
            Longest wait. By default as long as ``fitctl send --wait``.
        loop : str, optional
            As :meth:`send`.

        Raises
        ------
        SequenceError
            If the command is refused, fails, is ended by another command or is not done after `timeout_s`.
        ConfigError, TypeError, ConnectionError
            As :meth:`send`.

        Examples
        --------
        >>> with Instrument(simulate=True) as instrument:
        ...     instrument.send_and_wait("standby")
        ...     instrument.telemetry().loops[0].mode
        'STANDBY'
        """
        command = as_command(command, loop)
        row, reply = ROWS[type(command)], self.send(command)
        name = row.word or row.name
        if not reply.accepted:
            msg = f"{name} was refused: {reply.text}"
            raise SequenceError(msg)
        if not reply.number:
            return
        limit_s = timeout_s or row.wait_s
        for of_loop, outcome in wait_for_outcomes(self._link, reply, limit_s).items():
            if outcome.state != "done":
                late = f" after {limit_s:g} s" if outcome.state == "under way" else ""
                msg = f"loop {of_loop}: {name} {outcome.state}{late}: {outcome.text}".removesuffix(
                    ": "
                )
                raise SequenceError(msg)

    def telemetry(self) -> Telemetry:
        """The newest telemetry message.

        Returns
        -------
        Telemetry
            ``loops`` with mode and state of each loop, ``ticks``, ``devices`` and more; see
            :class:`fitctl.messages.telemetry.Telemetry`.

        Raises
        ------
        ConnectionError
            If no telemetry arrives within 2 s.
        """
        since_s = self._link.now_s()
        while True:
            telemetry = self._link.receive(2.0)
            if telemetry is None:
                msg = "the supervisor has been silent for 2 s; check it, then try again"
                raise ConnectionError(msg)
            if telemetry.time_s >= since_s:
                return telemetry

    def stop(self) -> None:
        """Stop every loop at once: SAFE. From any thread, also while a step runs.

        Raises
        ------
        SequenceError
            If the supervisor refuses it, for example with a viewer's key.
        """
        reply = self.send(Stop())
        if not reply.accepted:
            msg = f"stop is refused: {reply.text}"
            raise SequenceError(msg)

    def end_step(self) -> None:
        """From another thread: end the step or file that is running; its loops release their stars."""
        if self._runner is not None:
            self._runner.contact.stop_wanted.set()


def _load(path: Path | str | None, *, the_running: bool) -> Rig:
    """The rig of a file; without one, of FITCTL_RIG, else the one that runs or the shipped one."""
    named = Path(path) if path is not None else rig_of_environment()
    if named is not None or not the_running:
        return load_rig(named or default_rig_path())
    found = only_running_rig("Instrument")
    if found is None:
        raise ConnectionError(_NONE_RUNS)
    return load_rig(Path(found.file), found.settings)


def _where(rig: Rig, folder: Path | str | None, remote: Path | str | None) -> Path | RemoteKey:
    if remote is not None:
        return read_key_of(rig, Path(remote))
    return service_folder(rig) if folder is None else Path(folder)


class AsyncInstrument(StepMethods[Awaitable[Figures]]):
    """One instrument, to be awaited: the methods of :class:`Instrument`, with the same arguments and figures.

    Steps and files run one after the other, in a thread of their own. If you cancel a running step, it ends,
    and its loops release their stars. A step that you cancel before its turn never starts. :meth:`stop` and
    :meth:`send` wait for no step.

    Parameters
    ----------
    rig, simulate, folder, remote, seed
        As for :class:`Instrument`.

    Raises
    ------
    ConfigError, ConnectionError
        As :class:`Instrument`, when the ``async with`` block is entered.
    SequenceError
        From a method, if the block was not entered.

    Examples
    --------
    >>> import asyncio
    >>> async def night():
    ...     async with AsyncInstrument(simulate=True, seed=1) as instrument:
    ...         return await instrument.acquire()
    >>> sorted(asyncio.run(night()))  # doctest: +NORMALIZE_WHITESPACE
    ['acquired_s', 'found_az_sky_arcsec', 'found_el_sky_arcsec', 'found_flux_dn']
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
        self._unfinished: list[Runner] = []  # in their order; the first is the one that runs

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

    async def _at_once(self, work: Callable[[], T]) -> T:
        """In a new thread, so that it waits for nothing else; once begun it is done, also if cancelled."""
        thread = ThreadPoolExecutor(1, thread_name_prefix="instrument-command")
        doing = asyncio.wrap_future(thread.submit(work))
        thread.shutdown(wait=False)
        return await asyncio.shield(doing)

    async def run(self, step: steps.Step) -> Figures:
        """Run one step, as :meth:`Instrument.run`."""
        return (await self._run(NAME, [step]))[0]

    async def run_sequence(self, file: Path | str) -> list[Figures]:
        """Run a sequence file, as :meth:`Instrument.run_sequence`."""
        sequence = self._instrument._sequence(file)
        return await self._run(sequence.name, sequence.steps)

    async def _run(self, name: str, todo: Sequence[steps.Step]) -> list[Figures]:
        instrument = self._instrument
        runner = instrument._runner_of(name, todo)  # of its own, to be ended alone
        running = self._thread.submit(instrument._run, runner, todo)
        self._unfinished.append(runner)
        running.add_done_callback(lambda _: self._unfinished.remove(runner))
        ended = asyncio.wrap_future(running)
        try:
            return await asyncio.shield(ended)
        except asyncio.CancelledError:
            if not running.cancel():
                runner.contact.stop_wanted.set()
                await asyncio.wait([ended])
                ended.exception()  # it was stopped, as it was to be
            raise

    async def telemetry(self) -> Telemetry:
        """What the instrument is doing now; after the step that is running, if one is."""
        return await self._in_thread(self._instrument.telemetry)

    async def send(self, command: AnyCommand | str, loop: str = "") -> Reply:
        """Send one command as :meth:`Instrument.send`, at once, also while a step runs."""
        instrument = self._instrument
        return await self._at_once(lambda: instrument.send(command, loop))

    async def send_and_wait(
        self, command: AnyCommand | str, timeout_s: float | None = None, loop: str = ""
    ) -> None:
        """Send a command and wait, as :meth:`Instrument.send_and_wait`; after the step that is running."""
        instrument = self._instrument
        await self._in_thread(lambda: instrument.send_and_wait(command, timeout_s, loop))

    async def stop(self) -> None:
        """Stop every loop at once: SAFE, also while a step runs. Raises as :meth:`Instrument.stop`."""
        await self._at_once(self._instrument.stop)

    def end_step(self) -> None:
        """End the step or file that is running; its loops release their stars."""
        for runner in self._unfinished[:1]:
            runner.contact.stop_wanted.set()

    @property
    def attempts(self) -> list[SequenceAttempt]:
        """Every attempt so far of the step or file that began last, as the log has them."""
        return self._instrument.attempts

    async def write_calibrations(self, folder: Path | str) -> list[Path]:
        """Write what that step or file has measured, as :meth:`Instrument.write_calibrations`."""
        instrument = self._instrument
        return await self._at_once(lambda: instrument.write_calibrations(folder))
