"""What a screen or the command palette may ask of the console."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from fitctl.messages.commands import AnyCommand
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.graphics import PictureSender
from fitctl.tui.jobs import Job
from fitctl.tui.rewind.playback import Playback
from fitctl.tui.state import ConsoleState


class Console(Protocol):
    """The console without its screens; :class:`fitctl.tui.app.ConsoleApp` describes the attributes."""

    state: ConsoleState
    alarms: AlarmBook
    pictures: PictureSender | None
    clock: Callable[[], float]
    quit_shuts_down: bool
    rig_arguments: Sequence[str] | None
    remote_arguments: list[str]
    commissioning: Sequence[str] | None
    step_job: Job | None
    log_folder: Path | None
    start_job: Callable[..., Job]
    playback: Playback
    view_before: str

    def action_view(self, name: str) -> None:
        """Show a screen."""

    def send(self, command: AnyCommand) -> None:
        """Send a command for the shown loop."""

    def ask(self, title: str, question: str, then: Callable[[], object]) -> None:
        """Do something after the operator has confirmed it."""

    def end_step(self) -> None:
        """End the running step of the commissioning."""

    def draw_all(self) -> None:
        """Bring everything on the screen up to date now."""
