"""Sequences: choose one, change its parameters, rehearse it, run it, steer it."""

from __future__ import annotations

import os
import shutil
import tempfile
import tomllib
from pathlib import Path
from typing import Any, ClassVar

import tomli_w
from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.messages.commands import SequenceControl
from fitctl.tui.commands import keys_of
from fitctl.tui.dialogs import Ask
from fitctl.tui.jobs import Job, printed_json
from fitctl.tui.look import shorten
from fitctl.tui.views.view import View
from fitctl.tui.widgets.printed import Printed
from fitctl.tui.widgets.sequencing import Estimates, Parameters, Progress, SequenceList

HINT = (
    "Choose a sequence. tab and enter change its parameters, d rehearses all of it on the virtual clock, "
    "g runs it on the instrument."
)
NEEDS_RIG = (
    "The console needs the rig file to check, rehearse and run sequences, and does not have it here. Start the "
    "console again with --rig FILE. You can pause and end a running sequence without it."
)


_MOST_SHOWN = 60  # characters of a value in the prompt for another


class SequencesView(View):
    """Sequences at the left, parameters at the right, progress and what was printed below.

    Everything that is run is `fitctl sequence` as a process of its own, which goes on when the console
    is left.
    """

    view_name = "sequences"
    BINDINGS: ClassVar[list[BindingType]] = [
        key.binding() for key in keys_of("sequences") if key.action
    ]

    def __init__(self) -> None:
        super().__init__()
        self._folder = tempfile.mkdtemp(prefix="fitctl-console-")
        self._editions: dict[str, str] = {}  # file of each edited sequence, by content
        self._list: Job | None = None
        self._run: Job | None = None
        self._estimates = Estimates()

    def parts(self) -> ComposeResult:
        """Two lists, and two panels below them."""
        sequences = SequenceList(self.state, "Sequences", self._estimates.of)
        yield sequences
        yield Parameters(self.state, "Parameters", sequences)
        yield Progress(self.state, "On the instrument", sequences)
        hint = NEEDS_RIG if self.console.rig_arguments is None else HINT
        yield Printed(self.state, "Printed", hint)

    def on_mount(self) -> None:
        """Ask which sequences there are."""
        super().on_mount()
        self._list = self.console.start_job(["sequence", "list", "--json"])

    def on_unmount(self) -> None:
        """What was asked for is not waited for."""
        if self._list is not None:
            self._list.end()
        self._estimates.end()
        # A run goes on without the console, and may not have read its edition yet: that stays.
        if self._run is None or self._run.status is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def before_drawing(self) -> None:
        """Show the list of sequences once it has come."""
        self._estimate()
        job = self._list
        if job is None or job.status is None:
            return
        self._list = None
        printed = self.query_one(Printed)
        if job.status == 0:
            try:
                self._add(printed_json(job))
            except ValueError as error:
                self.notify(str(error), severity="error", timeout=8, markup=False)
            job.end()
        elif printed.moving is None:
            printed.show(job)  # it says why
        else:
            self.notify(job.text(), severity="error", timeout=8, markup=False)
            job.end()

    def _estimate(self) -> None:
        """Have the sequence under way run dry, or else the chosen one."""
        rig_arguments = self.console.rig_arguments
        for progress in self.query(Progress):  # there is none before the screen is composed
            document = progress.document() or self.query_one(SequenceList).document
            if document is not None and rig_arguments is not None:
                file = [self._file(document), *rig_arguments]
                self._estimates.ask(self.console.start_job, document, file, self.console.clock())

    def _add(self, documents: list[dict[str, Any]]) -> None:
        sequences = self.query_one(SequenceList)
        known = [d for d in sequences.documents if d["file"] not in {n["file"] for n in documents}]
        sequences.documents = [*known, *documents]
        if known:
            sequences.chosen = len(known)

    # ------------------------------------------------------------ keys

    def action_edit(self) -> None:
        """Change the chosen parameter."""
        sequences, parameter = self.query_one(SequenceList), self.query_one(Parameters).now()
        document = self._chosen()
        if document is None:
            return
        if parameter is None or not self.query_one(Parameters).takes_keys:
            self.notify("choose a parameter first: tab, then up and down", timeout=3)
            return
        step = document["steps"][parameter.step]

        def accept(value: str | None) -> None:
            if value is not None:
                step[parameter.key] = parsed(value)
                sequences.edited.add(document["file"])
                self._start(document, "check")

        value = typed(parameter.value)
        where = f"step {parameter.step + 1}, {step['step']}"
        prompt = f"{where}: {parameter.key} (is {shorten(value, _MOST_SHOWN)})"
        self.app.push_screen(Ask(document["name"], prompt, value), accept)

    def action_dry_run(self) -> None:
        """Rehearse the chosen sequence on the virtual clock, from where the stages are now."""
        document = self._chosen()
        if document is not None:
            from_now = [] if self.state.stale or not self.state.live else ["--present"]
            remote = self.console.remote_arguments if from_now else ()
            self._start(document, "dry-run", *from_now, *remote)

    def action_go(self) -> None:
        """Run the chosen sequence on the instrument, after the operator has confirmed it."""
        document = self._chosen()
        if document is None:
            return
        if not self.state.live:
            self.notify("Go: the console shows the past; press end first", timeout=4)
            return
        steps = ", ".join(step["step"] for step in document["steps"])
        question = f"Run {document['name']} on the instrument? It moves the stages: {steps}."
        remote = self.console.remote_arguments

        def run() -> None:
            self._start(document, "run", *remote, outlives=True)

        self.console.ask("Run", question, run)

    def action_pause(self) -> None:
        """Pause what is under way, or let it go on."""
        status = self.state.newest.running_sequence if self.state.newest else None
        paused = status is not None and "pause" in {status.wanted, status.state.removesuffix("d")}
        self.console.send(SequenceControl(action="resume" if paused else "pause"))

    def action_end(self) -> None:
        """End what is under way; its loops release their stars."""
        self.console.send(SequenceControl(action="end"))

    def action_file(self) -> None:
        """Read a file of the operator's own."""

        def accept(name: str | None) -> None:
            if name and self._list is None:
                self._list = self.console.start_job(["sequence", "list", "--json", name])

        def refused(name: str) -> str:
            return "" if os.path.isfile(name) else f"{name}: no such file"

        self.app.push_screen(Ask("Open", "a sequence file (TOML or YAML)", "", refused), accept)

    # ------------------------------------------------------------ children

    def _chosen(self) -> dict[str, Any] | None:
        """The chosen sequence; if nothing can be done with one, a notice shows why."""
        document = self.query_one(SequenceList).document
        if self.console.rig_arguments is None:
            self.notify(NEEDS_RIG, severity="warning", timeout=8, markup=False)
            return None
        if document is None:
            self.notify("no sequence is chosen yet", timeout=3)
        return document

    def _file(self, document: dict[str, Any]) -> str:
        """A sequence's own file, or, once it was edited, one of ours.

        Each edition has its own, which is written once: the process that was started with it may read it later.
        """
        sequences = self.query_one(SequenceList)
        if document["file"] not in sequences.edited:
            return document["file"]
        content = tomli_w.dumps({k: v for k, v in document.items() if k != "file"})
        if content not in self._editions:
            path = Path(tempfile.mkdtemp(dir=self._folder)) / f"{document['name']}.toml"
            path.write_text(content)
            self._editions[content] = str(path)
        return self._editions[content]

    def _start(
        self, document: dict[str, Any], word: str, *more: str, outlives: bool = False
    ) -> None:
        """Do something with a sequence; never with the file of another rig."""
        rig_arguments = self.console.rig_arguments
        if rig_arguments is not None:
            arguments = ["sequence", word, self._file(document), *rig_arguments, *more]
            printed = self.query_one(Printed)
            printed.start(self.console.start_job, *arguments, outlives=outlives)
            self._run = printed.moving


def typed(value: Any) -> str:
    """A value as it may be typed on one line; :func:`parsed` reads it again."""
    if isinstance(value, str) and parsed(value) == value:
        return value
    lines = tomli_w.dumps({"value": [value]}).split("\n")[1:-2]  # in a list, tables stay inline
    return " ".join(line.strip(" ") for line in lines).removesuffix(",")


def parsed(value: str) -> Any:
    """A TOML value, or, if it is none, the text itself."""
    try:
        document = tomllib.loads(f"value = {value}")
        tomli_w.dumps(document)  # it is written again for `fitctl sequence`
    except (ValueError, RecursionError):  # also too many digits, and lists too deep
        return value
    return document["value"]
