"""Where in time the console is: live, or at a moment of the past."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime

from fitctl.logging.records import Event
from fitctl.messages.commands import AnyCommand, Stop
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.look import wall
from fitctl.tui.rewind.moment import Recording
from fitctl.tui.rewind.player import Player
from fitctl.tui.state import ConsoleState

BEFORE_S = 5.0  # an alarm or an event opens at so long before it
SAME_S = 0.5  # an event this close to the shown moment is the one that was jumped to


class Playback:
    """Shows moments of a recording in place of the live state, and the live state again.

    `state` and `alarms` are what the panels draw. While they show the past, `live` and `live_alarms` go on
    following the supervisor.

    Parameters
    ----------
    state : ConsoleState
    alarms : AlarmBook
    recording : Recording
        Of the last ten minutes, or a log.
    log_name : str
        Of the log; empty for a console that follows a supervisor.
    from_thread : callable
        Calls a function with its arguments on the console's thread.
    notify : callable
        Shows a short text.
    draw : callable
        Brings the screen up to date.

    Attributes
    ----------
    shown_s : float or None
        The moment on the screen, by the supervisor's clock; None while live.
    pending : bool
        A moment was asked for and has not come yet.
    """

    def __init__(
        self,
        state: ConsoleState,
        alarms: AlarmBook,
        recording: Recording,
        log_name: str,
        *,
        from_thread: Callable[..., object],
        notify: Callable[[str], object],
        draw: Callable[[], object],
    ) -> None:
        self.state, self.alarms = state, alarms
        self.live, self.live_alarms = state, alarms
        self.recording = recording
        self.log_name = log_name
        self.shown_s: float | None = None
        self._wanted_s: float | None = None
        self._notify = notify
        self._draw = draw
        self._player = Player(recording, lambda *made: from_thread(self._show, *made))

    @property
    def pending(self) -> bool:
        """A moment was asked for and is not on the screen yet."""
        return self._wanted_s is not None

    @property
    def position_s(self) -> float:
        """The moment that was asked for last; live, that of the newest message."""
        for time_s in (self._wanted_s, self.shown_s):
            if time_s is not None:
                return time_s
        return self.live.received_s

    def why_not(self, command: AnyCommand) -> str:
        """Why a command is not sent now; empty if it is. STOP is always sent."""
        if isinstance(command, Stop):
            return "no instrument is attached to a log" if self.log_name else ""
        if self.log_name:
            return "this console shows a log; no instrument is attached"
        if self.state.live:
            return ""
        return (
            "the console shows the past; press end to go back to now. Only STOP is sent meanwhile"
        )

    def to(self, time_s: float) -> None:
        """Show the moment of a time; one after the newest is now, or a log's end."""
        oldest_s, newest_s = self.recording.span_s()
        if time_s >= newest_s and not self.log_name:
            self.now()
            return
        if time_s < oldest_s - SAME_S and self.position_s <= oldest_s:
            self._notify("there is nothing older" if self.log_name else "older data are in the log")
        self._wanted_s = min(max(time_s, oldest_s), newest_s)
        self._player.seek(self._wanted_s)

    def step(self, by_s: float) -> None:
        """Go back, or forward again."""
        if self.state.live and by_s > 0:
            self._notify("this is now")
        else:
            self.to(self.position_s + by_s)

    def oldest(self) -> None:
        """Show the oldest moment."""
        self.to(self.recording.span_s()[0])

    def now(self) -> None:
        """Follow the supervisor again; of a log, show its end."""
        if self.log_name:
            self.to(self.recording.span_s()[1])
            return
        self._wanted_s = self.shown_s = None
        if not self.state.live:
            self.state.become(self.live)
            self.alarms.become(self.live_alarms)
            self.live, self.live_alarms = self.state, self.alarms
        self._draw()

    def jump(self, direction: int) -> None:
        """Show the moment before the next (1) or the previous (-1) warning or error."""
        here_s = self.position_s + BEFORE_S
        times_s = [event.time_s for event in self.marks()]
        ahead = [t for t in times_s if direction * (t - here_s) > SAME_S]
        if ahead:
            self.to(min(ahead, key=lambda t: abs(t - here_s)) - BEFORE_S)
        else:
            self._notify(f"no {'later' if direction > 0 else 'earlier'} warning or error")

    def marks(self) -> list[Event]:
        """Warnings and errors within the recording."""
        oldest_s, newest_s = self.recording.span_s()
        return [
            event
            for event in self.recording.events()
            if event.severity != "info" and oldest_s <= event.time_s <= newest_s
        ]

    def time_of(self, text: str) -> float | None:
        """The moment of a text: ``03:14:07`` in UTC, ``-2:30`` before the newest; None if it has none."""
        words = text.strip().removeprefix("-").removeprefix("−")
        try:
            parts = [float(part) for part in words.split(":")]
        except ValueError:
            return None
        if not 1 <= len(parts) <= 3 or not all(math.isfinite(p) and p >= 0 for p in parts):
            return None
        if any(part >= 60.0 for part in parts[1:]):
            return None
        seconds = sum(part * 60.0**power for power, part in enumerate(reversed(parts)))
        newest_s = self.recording.span_s()[1]
        if text.strip()[:1] in {"-", "−"}:
            return newest_s - seconds
        newest_wall_s = self.state.wall_s(newest_s)
        if len(parts) < 3 or seconds >= 86400 or not math.isfinite(newest_wall_s):
            return None
        midnight = datetime.fromtimestamp(newest_wall_s, UTC).replace(
            hour=0, minute=0, second=0, microsecond=0
        )
        wall_s = midnight.timestamp() + seconds
        if wall_s > newest_wall_s:
            wall_s -= 86400.0  # of the evening before
        return newest_s + wall_s - newest_wall_s

    def refused(self, text: str) -> str:
        """Why no moment is shown for a text, or nothing."""
        time_s, oldest_s = self.time_of(text), self.recording.span_s()[0]
        if time_s is None:
            return "a time is 03:14:07, or -2:30"
        if time_s < oldest_s - SAME_S:
            older = "" if self.log_name else "; older data are in the log"
            return f"the oldest data here are of {wall(self.state.wall_s(oldest_s))}{older}"
        return ""

    def close(self) -> None:
        """End the thread."""
        self._player.close()

    def _show(self, time_s: float, made: tuple[ConsoleState, AlarmBook] | str) -> None:
        if self._wanted_s is None:
            return  # meanwhile it is live again
        if time_s == self._wanted_s:
            self._wanted_s = None
        if isinstance(made, str):
            self._notify(made)
            return
        if self.live is self.state:
            self.live, self.live_alarms = ConsoleState(time_s), AlarmBook()
            self.live.become(self.state)
            self.live_alarms.become(self.alarms)
        self.shown_s = time_s
        self.state.become(made[0])
        self.alarms.become(made[1])
        self._draw()
