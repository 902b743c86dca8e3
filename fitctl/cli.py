"""Commands. Each is short: it reads its options and calls the room that does the work.

What is slow to import is imported inside the command that needs it, so that ``--help`` is quick.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand
from typer.exceptions import TyperException

from fitctl.commands import completing, faulting, init, keys, log, sequence
from fitctl.commands.options import (
    JsonOption,
    LoopOption,
    RemoteOption,
    RigOption,
    SeedOption,
    SetOption,
    rig_of,
)
from fitctl.commands.welcome import welcome
from fitctl.config import ConfigError, default_rig_path

# Before numpy comes: its matrices are small here, and threads that wait for each other cost more than they
# give, above all beside a loop that must not be late.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

UNUSABLE = 2
INTERRUPTED = 130

app = typer.Typer(
    name="fitctl",
    help="Points starlight: acquires a star, pulls it in and holds it to a fraction of a pixel.",
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.add_typer(faulting.app, name="fault")
app.add_typer(log.app, name="log")
app.add_typer(sequence.app, name="sequence")
app.add_typer(keys.app, name="keys")

ControllerOption = Annotated[
    str | None,
    typer.Option(
        "--controller",
        metavar="NAME",
        help="eq20, lqg-ltr, minimum-variance, fslq, or a saved file.",
        autocompletion=completing.controllers,
    ),
]
ParentOption = Annotated[
    int | None,
    typer.Option(
        "--parent-pid", hidden=True, help="End when this process is no longer the parent."
    ),
]


def with_controller(
    path: Path | None, overrides: list[str] | None, controller: str | None
) -> list[str]:
    """The overrides, and with them one that gives every loop the named controller, if any."""
    if controller is None:
        return overrides or []
    loops = rig_of(path, overrides).loops
    return [*(overrides or []), *(f"loops.{n}.vernier.controller={controller}" for n in loops)]


def _rig_arguments(path: Path | None, overrides: list[str] | None) -> list[str]:
    """The same rig for another fitctl process."""
    arguments = ["--rig", str(path or default_rig_path())]
    for override in overrides or ():
        arguments += ["--set", override]
    return arguments


@app.command()
def demo(
    rig: RigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    duration: Annotated[
        float, typer.Option(min=1.0, help="Seconds to run without a console.")
    ] = 60.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="No console, also on a terminal.")
    ] = False,
    as_json: JsonOption = False,
    controller: ControllerOption = None,
) -> None:
    """Run the whole instrument on mock devices: see a star acquired and held.

    On a terminal the console comes up. Without one, or with --headless, the same runs for a while and
    a summary is printed at the end.
    """
    from fitctl.commands.instrument import run_demo

    overrides = with_controller(rig, overrides, controller)
    settings = rig_of(rig, overrides)
    console = not (headless or as_json) and sys.stdin.isatty() and sys.stdout.isatty()
    arguments = (rig or default_rig_path(), overrides, seed)
    raise typer.Exit(run_demo(settings, *arguments, duration, console=console, as_json=as_json))


@app.command()
def mocks(
    rig: RigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
    free_ports: Annotated[
        bool, typer.Option("--free-ports", help="Take any free port for every device.")
    ] = False,
    faults: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="What goes wrong and when: a TOML file of [[fault]] tables."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="What the camera shows: a log's frames, in place of the mock star."
        ),
    ] = None,
    parent_pid: ParentOption = None,
) -> None:
    """Serve the rig's mock devices on 127.0.0.1 until Ctrl-C, and print where they listen."""
    from fitctl.commands.fault import with_script
    from fitctl.commands.instrument import run_mocks

    settings = rig_of(rig, overrides)
    if faults is not None:
        settings = with_script(settings, faults)
    run_mocks(settings, seed, camera, as_json=as_json, free_ports=free_ports, parent_pid=parent_pid)


@app.command()
def doctor(rig: RigOption = None, overrides: SetOption = None, as_json: JsonOption = False) -> None:
    """Ask every device of the rig who it is; nothing is set, nothing moves.

    Exit status 1 if one is missing or is not as the rig file says.
    """
    from fitctl.commands.doctor import run_doctor

    raise typer.Exit(run_doctor(rig_of(rig, overrides), as_json=as_json))


@app.command()
def discover(
    broadcast: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where cameras are asked to say who they are.")
    ] = "255.255.255.255",
    wait_s: Annotated[
        float, typer.Option("--wait", min=0.01, max=60.0, help="For their answers, seconds.")
    ] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """List cameras, serial ports and CAN interfaces. Cameras are asked by a broadcast."""
    from fitctl.commands.doctor import run_discover

    run_discover(broadcast, wait_s, as_json=as_json)


@app.command()
def run(
    rig: RigOption = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    parent_pid: ParentOption = None,
) -> None:
    """Supervise the rig until Ctrl-C or a shutdown command; attach with `fitctl console`."""
    from fitctl.commands.instrument import run_rig

    overrides = with_controller(rig, overrides, controller)
    run_rig(rig_of(rig, overrides), _rig_arguments(rig, overrides), parent_pid=parent_pid)


@app.command()
def console(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    quitting_ends_instrument: Annotated[
        bool, typer.Option("--quitting-ends-instrument", hidden=True, help="Said in its help.")
    ] = False,
    graphics: Annotated[
        Literal["auto", "half-blocks", "sixel", "kitty"],
        typer.Option(
            envvar="FITCTL_GRAPHICS", help="How the focal plane is drawn; auto goes by TERM."
        ),
    ] = "auto",
    web: Annotated[bool, typer.Option("--web", help="In a browser on this machine.")] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Of --web, on 127.0.0.1.")] = 8000,
) -> None:
    """Attach an operator console to the running supervisor of a rig."""
    from fitctl.commands.connecting import connect
    from fitctl.commands.instrument import run_console

    arguments = ["--remote", str(remote)] if remote else _rig_arguments(rig, overrides)
    client = connect(rig, overrides, remote)
    if web:
        from fitctl.commands.web import serve_console

        client.close()  # what is wrong with the rig is said here, not in the browser
        serve_console(arguments, port)
        return
    # The logs of a rig elsewhere are elsewhere too.
    log_folder = None if remote else Path(rig_of(rig, overrides).logging.folder).expanduser()
    run_console(
        client,
        arguments,
        log_folder,
        quitting_ends_instrument=quitting_ends_instrument,
        graphics=graphics,
    )


class _SendCommand(TyperCommand):
    """Its help ends with every command, from the table that they are made from."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        from fitctl.supervisor.command_table import WORDS

        with formatter.section("Commands"):
            formatter.write_dl([(row.usage, row.help) for row in WORDS.values()])


@app.command(cls=_SendCommand, context_settings={"ignore_unknown_options": True})  # -1 is a value
def send(
    command: Annotated[str, typer.Argument(help="One of those below.")],
    values: Annotated[list[str] | None, typer.Argument(help="What it needs.")] = None,
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    loop: Annotated[
        str,
        typer.Option(help="One loop by name; without it, all.", autocompletion=completing.loops),
    ] = "",
) -> None:
    """Give one command to the running supervisor of a rig."""
    from fitctl.commands.connecting import connect
    from fitctl.commands.instrument import send_command
    from fitctl.supervisor.command_table import command_of

    wanted = command_of(command, values or [], loop)
    if remote is None and loop and loop not in (loops := rig_of(rig, overrides).loops):
        msg = f"send: --loop {loop!r}: the rig has {', '.join(loops)}"
        raise ConfigError(msg)
    raise typer.Exit(send_command(connect(rig, overrides, remote), wanted))


@app.command()
def status(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say how the running instrument of a rig is.

    Exit status 0 if all is well, 1 if something is not, 3 if no supervisor answers.
    """
    from fitctl.commands.connecting import connect
    from fitctl.commands.status import run_status

    raise typer.Exit(run_status(connect(rig, overrides, remote), as_json=as_json))


@app.command()
def watch(
    rig: RigOption = None,
    overrides: SetOption = None,
    remote: RemoteOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Each line is one JSON object; `kind` says what of.")
    ] = False,
    duration: Annotated[
        float | None, typer.Option(min=0.1, metavar="SECONDS", help="Without it, until Ctrl-C.")
    ] = None,
) -> None:
    """Print a line a second about the running instrument, and every event as it comes."""
    from fitctl.commands.connecting import connect
    from fitctl.commands.watch import run_watch

    raise typer.Exit(run_watch(connect(rig, overrides, remote), duration, as_json=as_json))


@app.command()
def simulate(
    rig: RigOption = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    seed: SeedOption = 0,
    duration: Annotated[
        float, typer.Option(min=1.0, max=1e6, help="Seconds of virtual time.")
    ] = 120.0,
    runs: Annotated[
        int, typer.Option(min=1, help="How many, with seeds from --seed on, on every core.")
    ] = 1,
    scheduler: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Run on a Dask cluster: tcp://host:port.")
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Acquire and hold on the virtual clock: same supervisor and plant, no wires, much faster.

    With --runs, means, percentiles and the worst seeds of many runs; each is the run that its seed
    gives alone.
    """
    from fitctl.commands.simulate import run_many, run_simulation

    settings = rig_of(rig, with_controller(rig, overrides, controller))
    if runs == 1 and not scheduler:
        raise typer.Exit(run_simulation(settings, seed, duration, as_json=as_json))
    seeds = range(seed, seed + runs)
    raise typer.Exit(run_many(settings, seeds, duration, scheduler, as_json=as_json))


@app.command()
def replay(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="All files of one run, from its first on."),
    ],
    rig: Annotated[
        Path | None,
        typer.Option("--rig", metavar="FILE", help="Rig file; without it, the one in the log."),
    ] = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Feed a log's frames through today's code, and tell where it decides otherwise.

    Exit status 0 if every mode and every command is the same to the last bit, 1 if not, 2 if the log
    cannot be replayed. A changed command changes no frames.
    """
    from fitctl.commands.replay import run_replay

    raise typer.Exit(run_replay(logs, rig, overrides or [], controller, as_json=as_json))


@app.command()
def identify(
    what: Annotated[str, typer.Argument(help="hysteresis, backlash, response, airpath or delay.")],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    log: Annotated[
        Path | None, typer.Option(help="Learn from this log (or bench file) of an earlier run.")
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulate", help="Experiment on the virtual clock, in seconds.")
    ] = False,
    mock: Annotated[
        bool, typer.Option("--mock", help="Start the rig's mock devices and experiment on them.")
    ] = False,
    seed: SeedOption = 0,
    out: Annotated[
        Path | None, typer.Option(help="The rig fragment; by default RIG-LOOP-WHAT.toml.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="The plot; by default beside the fragment, as PNG.")
    ] = None,
) -> None:
    """Measure what a rig truly is, and write it as a fragment that its rig file includes.

    Without --log, --simulate or --mock the rig's running supervisor does the experiment: the loop must
    hold a star in VERNIER. The stages move open loop meanwhile; a stop ends it at once.
    """
    from fitctl.commands.identify import Output, Source
    from fitctl.commands.identify import identify as run
    from fitctl.identify.experiments import EXPERIMENTS

    if what not in EXPERIMENTS:
        msg = f"identify: {what} cannot be identified; there are {', '.join(EXPERIMENTS)}"
        raise ConfigError(msg)
    if (log is not None) + simulated + mock > 1:
        msg = "identify: --log, --simulate and --mock exclude each other; give one, or none for the rig"
        raise ConfigError(msg)
    settings = rig_of(rig, overrides)
    path = rig or default_rig_path()
    source, output = Source(log, simulated, mock, seed), Output(out, plot)
    raise typer.Exit(run(settings, path, overrides or [], what, loop, source, output))


@app.command()
def design(
    what: Annotated[
        str,
        typer.Argument(
            help="vernier, coarse, bound, compare, or a pair: eq20, lqg-ltr, minimum-variance, fslq."
        ),
    ],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    as_json: JsonOption = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw Fig. 9 (vernier), PNG or SVG.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Save the pair (*.json), for loops.NAME.vernier.controller."
        ),
    ] = None,
) -> None:
    """Design the loop's controllers from the rig file: margins, residual, and the bound for any.

    vernier is LQG/LTR as the paper does it; compare sets all pairs side by side.
    """
    from fitctl.commands.design import Output, run_design

    run_design(rig_of(rig, overrides), what, loop, Output(as_json, plot, out))


@app.command()
def figures(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for everything; made if missing.")
    ],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    seed: SeedOption = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few and short runs: to see how it looks.")
    ] = False,
) -> None:
    """Make the paper's figures from this system, and measure what every controller shows.

    Figs. 3, 5, 6, 7, 9, 11 and 12 as PNG and SVG, with captions and beside the paper's numbers in
    figures.md; residuals, attenuation, steps and piston in performance.md; both as JSON too.
    """
    from fitctl.commands.figures import run_figures

    settings = rig_of(rig, overrides)
    raise typer.Exit(run_figures(settings, loop, seed, out, quick=quick))


app.command()(init.init)


@app.command()
def report(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Files of one run, or a folder: its newest run."),
    ],
    compare: Annotated[
        bool, typer.Option("--compare", help="Each LOG is a night of its own; side by side.")
    ] = False,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="As PDF too; needs Chromium or Chrome.")
    ] = False,
    show: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for everything; else beside the first LOG."),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Judge by this rig file, not by the one in the log."),
    ] = None,
) -> None:
    """Say on one page whether a night was good: verdict, plots, losses, configuration.

    One HTML file that needs nothing from elsewhere, every plot as PNG and SVG, all figures as JSON.
    """
    from fitctl.commands.report import run_report

    settings = None if rig is None else rig_of(rig, None)
    raise typer.Exit(run_report(logs, settings, out, compare=compare, show=show, pdf=pdf))


@app.command()
def plot(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="An MCAP file, finished or not.")],
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="TOPIC...",
            help="/fit/right/tick.error_az_px, a topic, or a field; * is anything.",
        ),
    ],
    from_: Annotated[
        str, typer.Option("--from", metavar="TIME", help="Seconds after LOG's start, or UTC.")
    ] = "0",
    to: Annotated[str | None, typer.Option("--to", metavar="TIME", help="The same.")] = None,
    window: Annotated[
        bool, typer.Option("--window", help="In a window, not in the terminal.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="As a picture: PNG, SVG or PDF.")
    ] = None,
) -> None:
    """Draw fields of a log in the terminal, one panel for each unit."""
    from fitctl.commands.plot import run_plot

    raise typer.Exit(run_plot(log, what, (from_, to), window=window, out=out))


@app.command()
def check(rig: RigOption = None, overrides: SetOption = None) -> None:
    """Read a rig file and say whether it is well."""
    from fitctl.commands.instrument import check_plant

    settings = rig_of(rig, overrides)
    check_plant(settings)
    loops = ", ".join(settings.loops)
    typer.echo(f"{rig or default_rig_path()}: well; rig {settings.name}, loops {loops}")


@app.command(hidden=True)
def record(
    rig: RigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Record what a supervisor sends; the supervisor starts this by itself."""
    from fitctl.commands.instrument import run_recorder

    run_recorder(rig_of(rig, overrides), parent_pid=parent_pid)


@app.command(hidden=True)
def metrics(
    rig: RigOption = None, overrides: SetOption = None, parent_pid: ParentOption = None
) -> None:
    """Serve metrics of the running instrument; the supervisor starts this by itself."""
    from fitctl.commands.instrument import run_metrics

    run_metrics(rig_of(rig, overrides), parent_pid=parent_pid)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: what an operator can mend is one line for each thing, and exit status 2."""
    given = sys.argv[1:] if arguments is None else arguments
    if not given and "_FITCTL_COMPLETE" not in os.environ:
        typer.echo(welcome(Path.cwd()))
        return
    try:
        status = app(given, prog_name="fitctl", standalone_mode=False)
    except ConfigError as error:
        typer.echo(str(error), err=True)
        status = UNUSABLE
    except TyperException as error:
        context = getattr(error, "ctx", None)
        command = "fitctl" if context is None else context.command_path
        typer.echo(f"{command}: {_message(error)} (see {command} --help)", err=True)
        status = UNUSABLE
    except (KeyboardInterrupt, typer.Abort):
        status = INTERRUPTED
    sys.exit(status)


def _message(error: TyperException) -> str:
    """The error as one line, with the option that it is about."""
    format_message = getattr(error, "format_message", None)
    text = str(error) if format_message is None else format_message()
    return text.replace("\n", " ").rstrip(".")
