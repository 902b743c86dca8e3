"""`fitctl design learn`: from a log to the night that it shows, and to a pair for that night."""

from __future__ import annotations

from pathlib import Path

from fitctl.commands.shared.logs import say_left_out, say_unreadable
from fitctl.commands.shared.opened import opened_loop
from fitctl.commands.shared.printing import say_lines, to_json
from fitctl.commands.shared.rig import require_loop, rig_of
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import solving
from fitctl.controllers.design.files import save_design
from fitctl.learn.advice import Advice, advise
from fitctl.report.gather import gather
from fitctl.report.run import Run, find_run


def learn(
    logs: list[Path],
    rig: Path | None,
    overrides: list[str] | None,
    loop: str,
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    """Print a night's estimates and what designs leave of it; write the learnt design to `out`.

    Raises
    ------
    ConfigError
        If the log shows too little of the loop, or no design has the margins.
    LogError
        If the log cannot be read.
    """
    run = find_run(logs, rig_of(rig, overrides) if rig else None, overrides or ())
    say_unreadable(run.unreadable)
    require_loop("design learn", run.rig, loop)
    advice = "look at the log with fitctl report, or at the rig file that --rig or --set gives"
    with solving("design learn", loop, advice):
        found = _advice(run, loop)
    if out is not None:
        save_design(found.design, out)
    say_lines(to_json(found.numbers()) if as_json else "\n".join(found.lines_of_text()))
    if out is not None and not as_json:
        say_lines(f"written: {out} (name it in loops.{loop}.vernier.controller)")


def _advice(run: Run, loop_name: str) -> Advice:
    gathered = gather(run)
    say_left_out(gathered)
    loop = opened_loop(gathered, loop_name)
    return advise(
        loop.series,
        loop.measured_px,
        basis(run.rig, loop_name),
        loop.present,
        others=loop.others,
    )
