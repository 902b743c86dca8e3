"""Commissioning: its steps and what came of them; run, repeat and skip them; watch the running one."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.tui.commands import keys_of
from fitctl.tui.dialogs import Ask, Confirm
from fitctl.tui.jobs import Job, printed_json
from fitctl.tui.steps import StepFacts, StepList
from fitctl.tui.views.view import View
from fitctl.tui.widgets.printed import Printed

HINT = (
    "g does the steps that are left to do, d the chosen one, n leaves it out with a reason. Each step asks "
    "before it moves anything. z and STOP end the running step: its motors stand and lose their power."
)
ELSEWHERE = (
    "This console only shows the steps: they need the devices, which a supervisor has. To do them, end the "
    "supervisor and run: fitctl commission --console"
)
NEEDS_RIG = (
    "The steps are those of a rig file, which is not known here: leave the console, and give it that file, "
    "with --rig FILE."
)
_ENTER = "press Enter"


class CommissioningView(View):
    """Steps at the left, the chosen one at the right, what the running one prints below.

    The steps are done by ``fitctl commission`` as a process of its own. It asks its questions here as on a
    terminal, keeps the same record, and ends with the console.
    """

    view_name = "commissioning"
    BINDINGS: ClassVar[list[BindingType]] = [
        key.binding() for key in keys_of("commissioning") if key.action
    ]

    def __init__(self) -> None:
        super().__init__()
        self._list: Job | None = None
        self._asked = ""
        self._dialog: Confirm | None = None

    def parts(self) -> ComposeResult:
        """The list, the chosen step beside it, and the output below."""
        steps = StepList(self.state, "Steps")
        yield steps
        yield StepFacts(self.state, "The chosen step", steps)
        yield Printed(self.state, "Output", self._why_not or HINT)

    @property
    def _why_not(self) -> str:
        """Why this console does no steps; empty where it does."""
        if self.console.rig_arguments is None:
            return NEEDS_RIG
        return ELSEWHERE if self.console.commissioning is None else ""

    def on_screen_resume(self) -> None:
        """Read the record, which may have changed meanwhile; while a step runs, its questions come here."""
        if self.console.step_job is None:
            self._read()

    def on_unmount(self) -> None:
        """End the process that reads the record, if it still runs."""
        if self._list is not None:
            self._list.end()

    def _read(self) -> None:
        if self._list is None and self.console.rig_arguments is not None:
            rig = self.console.commissioning or self.console.rig_arguments
            self._list = self.console.start_job(["commission", "--list", "--json", *rig])

    def before_drawing(self) -> None:
        """Show the record once it is read, and pass on what the running step asks."""
        for steps in self.query(StepList):  # there is none before the screen is composed
            self._show_list(steps)
            self._follow(steps)

    def _show_list(self, steps: StepList) -> None:
        job = self._list
        if job is None or job.status is None:
            return
        self._list = None
        if job.status == 0:
            before = steps.next_name
            try:
                steps.listed = printed_json(job)
            except ValueError as error:
                self.notify(str(error), severity="error", timeout=8, markup=False)
            if steps.next_name != before:
                steps.choose(steps.next_name)
        else:
            self.notify(job.text(), severity="error", timeout=8, markup=False)
        job.end()

    def _follow(self, steps: StepList) -> None:
        """Ask what the running step asks, once; when it ends, read the record."""
        job = self.console.step_job
        if job is None:
            return
        printed = job.text()
        if job.status is not None:
            self.console.step_job, self._asked, steps.running = None, "", ""
            if self._dialog is not None and self._dialog.is_current:
                self._dialog.dismiss(None)  # this screen resumes, and reads the record
            else:
                self._read()
            return
        question = job.question()
        if question and printed != self._asked:
            since = printed.removeprefix(self._asked)
            self._asked, steps.running = printed, ""
            self._read()  # the step before has its result
            self._pass_on(job, question, since)
        elif not question:
            running = [step["name"] for step in steps.steps if _begins(step, printed)]
            steps.running = running[-1] if running else ""

    def _pass_on(self, job: Job, question: str, since: str) -> None:
        by_hand = _ENTER in question
        moves = [line.strip() for line in since.splitlines()[-3:]]
        words = "\n\n".join(moves[:-1]) if not by_hand else f"{question.partition(',')[0]}."

        def answered(yes: bool | None) -> None:
            self._dialog = None
            if by_hand and not yes:
                self.console.end_step()
            else:
                job.answer("yes" if yes else "no")

        title = "Your hand is needed: y when it is done" if by_hand else "Begin this step?"
        self._dialog = Confirm(title, words)
        self.app.push_screen(self._dialog, answered)

    # ------------------------------------------------------------ keys

    def action_go(self) -> None:
        """Do the steps that are left to do, each once it was agreed to."""
        self._start()

    def action_do(self) -> None:
        """Do the chosen step, also if it was done."""
        step = self.query_one(StepList).step
        if step is not None:
            self._start("--only", step["name"])

    def action_skip(self) -> None:
        """Leave the chosen step out."""
        step = self.query_one(StepList).step
        if step is None or not self._may_start():
            return

        def refused(reason: str) -> str:
            return "" if reason.strip() else "the record needs a reason, such as: no star tonight"

        def skip(reason: str | None) -> None:
            if reason is not None:
                self._start("--only", step["name"], "--skip", f"{step['name']}={reason}")

        prompt = "why it is left out; the reason stays in the record"
        self.app.push_screen(Ask(f"Skip {step['name']}", prompt, "", refused), skip)

    def action_end(self) -> None:
        """End the running step."""
        self.console.end_step()

    def _may_start(self) -> bool:
        if self._why_not:
            self.notify(self._why_not, severity="warning", timeout=8, markup=False)
        return not self._why_not

    def _start(self, *more: str) -> None:
        if not self._may_start():
            return
        printed = self.query_one(Printed)
        busy = printed.moving is not None
        printed.start(
            self.console.start_job,
            "commission",
            *(self.console.commissioning or ()),
            *more,
            asks=True,
        )
        if not busy:
            self.console.step_job, self._asked = printed.job, ""


def _begins(step: dict[str, str], printed: str) -> bool:
    """Whether the output has come to a step."""
    return f"{step['name']}: {step['title']}." in printed
