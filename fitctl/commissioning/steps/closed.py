"""The loop is closed, by a supervisor of its own: first at a tenth of the gain, then whole."""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from fitctl.commissioning.outcome import Outcome, Site, StepError
from fitctl.daemon.locks import only_master, only_supervisor
from fitctl.logging.records import Tick
from fitctl.messages.client import Client
from fitctl.messages.commands import Acquire, AnyCommand, Recover, Standby, Stop
from fitctl.messages.endpoints import make_service_folder
from fitctl.messages.modes import Mode
from fitctl.messages.waiting import wait_for_outcomes
from fitctl.processes import end_process, last_line, rig_arguments, start_process

GENTLE = 0.1
SETTLED_S = 3.0
HELD_S = 20.0
_START_S = 60.0
_END_S = 30.0
ACQUIRE_S = 120.0
_AWAY_PX = 4.0
_STOP_LIMIT_S = 5.0
STOPPED_S = 1.0
_NEWS_S = 5.0
_OF_THE_LINK_TOO: dict[type[AnyCommand], tuple[AnyCommand, Mode]] = {
    Standby: (Standby(), Mode.OFF),
    Recover: (Recover(), Mode.SAFE),
    Acquire: (Acquire(), Mode.STANDBY),
}
"""What the loop of the link is commanded before its stellar loop, and in which of its modes."""


class Loop:
    """A supervisor's loop, watched by its ticks.

    Parameters
    ----------
    site : Site
    client : Client
    """

    def __init__(self, site: Site, client: Client) -> None:
        self._site = site
        self.client = client
        self.mode = ""
        stellar = site.rig.stellar_loops.get(site.name)
        self._link = (stellar.link if stellar else None) or ""

    def ticks(self, until: Callable[[Tick], bool], timeout_s: float) -> list[Tick]:
        """All ticks from now up to the first for which `until` is true.

        Raises
        ------
        StepError
            If there is none in time, or the loop goes to SAFE.
        """
        found: list[Tick] = []
        since_s = time.monotonic()
        end_s = since_s + timeout_s
        while time.monotonic() < end_s:
            telemetry = self.client.receive(0.5)
            for tick in () if telemetry is None else telemetry.ticks:
                if not isinstance(tick, Tick) or tick.loop != self._site.name:
                    continue
                if tick.time_s < since_s:  # of before the last command
                    continue
                found.append(tick)
                self.mode = tick.mode
                if until(tick):
                    return found
                if tick.mode == Mode.SAFE.name:
                    msg = f"the loop went to SAFE: {self.reason()}"
                    raise StepError(msg)
        msg = f"the loop is in {self.mode or 'no mode'} after {timeout_s:g} s; look at the supervisor's log"
        raise StepError(msg)

    def reason(self) -> str:
        """Why the loop is in its mode, by the newest telemetry."""
        telemetry = self.client.receive(1.0)
        loops = () if telemetry is None else telemetry.loops
        changes = [one.last_change for one in loops if one.name == self._site.name]
        return next((one.reason for one in changes if one is not None), "see the supervisor's log")

    def command(self, command: AnyCommand) -> None:
        """Send a command to this loop alone, and to that of its link where it needs it; wait until it is done.

        Raises
        ------
        StepError
            If it is refused or fails.
        """
        if self._link and type(command) in _OF_THE_LINK_TOO:
            first, mode = _OF_THE_LINK_TOO[type(command)]
            if self.mode_of(self._link) == mode.name:
                self._command(msgspec.structs.replace(first, loop=self._link))
        self._command(msgspec.structs.replace(command, loop=self._site.name))

    def mode_of(self, name: str) -> str:
        """The mode that a loop has now; empty where no telemetry comes."""
        since_s = time.monotonic()
        while time.monotonic() < since_s + _NEWS_S:
            telemetry = self.client.receive(0.5)
            if telemetry is not None and telemetry.time_s >= since_s:
                return next((one.mode for one in telemetry.loops if one.name == name), "")
        return ""

    def _command(self, command: AnyCommand) -> None:
        reply = self.client.send(command)
        if not reply.accepted:
            msg = f"the supervisor refuses {type(command).__name__.lower()}: {reply.text}"
            raise StepError(msg)
        if isinstance(command, Acquire) or not reply.number:  # without one, it is done at once
            return
        for outcome in wait_for_outcomes(self.client, reply, _START_S).values():
            if outcome.state != "done":
                msg = f"{type(command).__name__.lower()} {outcome.state}: {outcome.text}"
                raise StepError(msg)

    def until(self, mode: Mode, timeout_s: float = ACQUIRE_S) -> Tick:
        """The first tick in a mode.

        Raises
        ------
        StepError
            If there is none in time, or the loop goes to SAFE.
        """
        return self.ticks(lambda tick: tick.mode == mode.name, timeout_s)[-1]

    def wait_for(self, mode: Mode, timeout_s: float) -> float:
        """How long it takes until the loop is in a mode, SAFE too; NaN if it takes too long."""
        began_s = time.monotonic()
        while time.monotonic() < began_s + timeout_s:
            telemetry = self.client.receive(0.2)
            loops = () if telemetry is None else telemetry.loops
            if any(one.name == self._site.name and one.mode == mode.name for one in loops):
                return time.monotonic() - began_s
        return math.nan

    def acquire(self) -> float:
        """Acquire, until the star is held by the mirror; returns how long it took."""
        began_s = time.monotonic()
        self.command(Acquire())
        self.ticks(lambda tick: tick.mode != Mode.STANDBY.name, ACQUIRE_S)
        self.until(Mode.VERNIER)
        return time.monotonic() - began_s

    def hold(self, for_s: float) -> dict[str, float]:
        """Hold for a time; the RMS of the error, the worst, and how much of the mirror's range is used.

        Raises
        ------
        StepError
            If the star is lost, or the loop leaves VERNIER.
        """
        end_s = time.monotonic() + for_s
        ticks = self.ticks(lambda _tick: time.monotonic() > end_s, for_s + 5.0)
        left = [tick.mode for tick in ticks if tick.mode != Mode.VERNIER.name]
        if left:
            msg = f"the loop left VERNIER for {left[0]} while it held the star"
            raise StepError(msg)
        seen = [tick for tick in ticks if tick.star_visible]
        errors = np.array([(tick.error_az_px, tick.error_el_px) for tick in seen])
        az, el = np.sqrt(np.mean(errors**2, axis=0))
        return {
            "rms_az_px": float(az),
            "rms_el_px": float(el),
            "worst_px": float(np.max(np.abs(errors))),
            "without_star": 1 - len(seen) / len(ticks),
            "mirror_range": float(max(tick.fsm_range_fraction for tick in ticks)),
            "late_ticks": float(sum(tick.late for tick in ticks)),
        }

    def mean_px(self, for_s: float) -> NDArray[np.float64]:
        """Where the star is on average over a time.

        Raises
        ------
        StepError
            If the loop has lost it.
        """
        end_s = time.monotonic() + for_s
        ticks = self.ticks(lambda _tick: time.monotonic() > end_s, for_s + 5.0)
        places = [(tick.star_az_px, tick.star_el_px) for tick in ticks if tick.star_visible]
        if len(places) < len(ticks) / 2:
            msg = f"the star was on {len(places)} of {len(ticks)} frames"
            raise StepError(msg)
        return np.asarray(np.mean(places, axis=0), dtype=float)

    def stop(self) -> float:
        """STOP; returns how long until SAFE.

        Raises
        ------
        StepError
            If it takes longer than a few seconds.
        """
        self.client.send(Stop())
        took_s = self.wait_for(Mode.SAFE, _STOP_LIMIT_S)
        if math.isnan(took_s):
            msg = f"STOP did not lead to SAFE within {_STOP_LIMIT_S:g} s; use the emergency stop"
            raise StepError(msg)
        return took_s


@contextmanager
def supervised(site: Site, *overrides: str) -> Iterator[Loop]:
    """A supervisor of the rig with its loop in STANDBY inside; stopped and ended afterwards.

    Raises
    ------
    StepError
        If it does not start, or a device fails.
    ConfigError
        If another supervisor has the rig or one of its devices.
    """
    folder = make_service_folder(site.rig)
    with only_supervisor(folder), only_master(site.rig):
        pass  # else the commands below would reach another supervisor
    with tempfile.TemporaryDirectory(prefix="fitctl-commission-") as scratch:
        errors = Path(scratch) / "supervisor.err"
        with errors.open("wb") as stderr:
            arguments = rig_arguments(site.rig_path, [*site.overrides, *overrides])
            process = start_process(["run", *arguments], stderr=stderr)
        client = Client(folder)
        try:
            loop = Loop(site, client)
            end_s = time.monotonic() + _START_S
            while (heard := client.receive(0.5)) is None or heard.pid != process.pid:
                if process.poll() is not None or time.monotonic() > end_s:
                    msg = f"the supervisor does not start: {last_line(errors) or 'no message'}"
                    raise StepError(msg)
            loop.command(Standby())
            yield loop
            loop.stop()
        except ConnectionError as error:
            msg = f"the supervisor does not answer: {error}; {last_line(errors)}"
            raise StepError(msg) from None
        finally:
            with contextlib.suppress(ConnectionError):
                client.send(Stop())
            client.close()
            end_process(process, _END_S)


def with_link(site: Site, text: str) -> str:
    """What a step moves, and what moves with it where the star comes over a link."""
    link = site.loop.link
    return f"{text}; and the siderostat of {link}, which holds the link" if link else text


def gentle_moves(site: Site) -> str:
    """What the step moves."""
    return with_link(
        site,
        "the siderostat, to the star and up to "
        f"{site.loop.acquisition.search_radius_sky_arcsec:g} arcsec on the sky "
        f"in search of it, with {GENTLE:g} of coarse.gain_rad_per_m; stopped as soon as the star moves away",
    )


def check_gentle(site: Site) -> Outcome:
    """Close the siderostat's loop at a tenth of its gain: the star must come nearer.

    Raises
    ------
    StepError
        If it goes away instead, or is not reached.
    """
    gain = GENTLE * site.loop.coarse.gain_rad_per_m
    key = f"loops.{site.name}.coarse.gain_rad_per_m={gain:g}"
    distances_px: list[float] = []

    def arrived_or_away(tick: Tick) -> bool:
        if tick.mode == Mode.COARSE.name and tick.star_visible:
            distances_px.append(math.hypot(tick.error_az_px, tick.error_el_px))
        away = bool(distances_px) and distances_px[-1] > min(distances_px) + _AWAY_PX
        return tick.mode == Mode.VERNIER.name or away

    with supervised(site, key) as loop:
        loop.command(Acquire())
        last = loop.ticks(arrived_or_away, ACQUIRE_S)[-1]
        stopped_s = loop.stop()
    figures = {"stop_s": stopped_s}
    if distances_px:
        figures |= {"began_px": distances_px[0], "ended_px": distances_px[-1]}
    if last.mode != Mode.VERNIER.name:
        msg = (
            f"the star moved away from its target, from {min(distances_px):.1f} to "
            f"{distances_px[-1]:.1f} px; its signs or rotation are wrong: repeat the step "
            f"{site.name}.siderostat"
        )
        raise StepError(msg, figures)
    if stopped_s > STOPPED_S:
        msg = f"STOP took {stopped_s:.2f} s to SAFE, expected less than {STOPPED_S:g} s"
        raise StepError(msg, figures)
    came = f"from {distances_px[0]:.1f} px " if distances_px else ""
    return Outcome([f"the star came {came}to its target; STOP took {stopped_s:.2f} s"], figures)


def whole_moves(site: Site) -> str:
    """What the step moves."""
    return with_link(
        site,
        "siderostat and mirror, as in operation, within "
        f"{site.loop.siderostat.travel_sky_arcsec:g} arcsec on the sky",
    )


def check_whole(site: Site) -> Outcome:
    """Close the whole loop with the rig file's gains, and hold.

    Raises
    ------
    StepError
        If the star is not held.
    """
    with supervised(site) as loop:
        took_s = loop.acquire()
        time.sleep(SETTLED_S)
        figures = {"acquired_s": took_s} | loop.hold(HELD_S)
    return judged(site, figures, f"held for {HELD_S:g} s")


def judged(site: Site, figures: dict[str, float], what: str) -> Outcome:
    """What figures of :meth:`Loop.hold` come to.

    Raises
    ------
    StepError
        If the star is not held to the requirement.
    """
    rms_px = max(figures["rms_az_px"], figures["rms_el_px"])
    wanted_px = site.loop.requirement_px
    lines = [
        f"{what}: RMS az {figures['rms_az_px']:.4f}, el {figures['rms_el_px']:.4f} px "
        f"(requirement {wanted_px:g} px), "
        f"worst {figures['worst_px']:.3f} px, mirror within {figures['mirror_range']:.0%} of its range"
    ]
    if rms_px > wanted_px:
        msg = (
            f"the star is held to {rms_px:.3f} px RMS; the requirement is {wanted_px:g} px; "
            "identify air path, delay and "
            "hysteresis (docs/identifying.md) and choose a design (docs/designing.md)"
        )
        raise StepError(msg, figures)
    return Outcome(lines, figures)
