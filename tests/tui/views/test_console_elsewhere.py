"""A console of a rig on another machine: what it may say and run with a rig file, and what not without one."""

import json

import pytest

from fitctl.messages.commands import SequenceControl
from fitctl.messages.telemetry import LearningState
from fitctl.tui.dialogs import Confirm
from fitctl.tui.widgets.margins import DesignFigures, DesignInUse, Margins
from fitctl.tui.widgets.printed import Printed
from fitctl.tui.widgets.spectrum import ErrorBudget
from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import FakeJob, FixedApp
from tests.tui.live import notifications
from tests.tui.piloted import pressed, run_app, sent

LEARNT_JSON = '{"name":"minimum-variance","parameters":{}}'

KEY = ["--remote", "anna.key.toml"]
RIG = ["--rig", "theirs.toml", "--set", "camera.exposure_s=0.01"]


def told(panel):
    """A panel's lines as one paragraph."""
    return " ".join(
        " ".join(panel.render_line(y).text for y in range(panel.size.height)).split()
    ).replace("│ ", "")


def attached(scenario, *, rig=None, key=KEY, size=(120, 40), **told):
    """A console that was given these options, after a scenario on it, and what its supervisor told."""
    supervisor = FakeSupervisor()
    for name, value in told.items():
        setattr(supervisor, name, value)
    app = FixedApp(supervisor, rig_arguments=rig, remote_arguments=key, log_folder=None)
    run_app(app, lambda pilot: scenario(app, pilot), size=size)
    return app


def commands(app):
    return [job.arguments for job in app.jobs if job.arguments[:2] != ["sequence", "list"]]


# ---------------------------------------------------------------- without the rig file


@pytest.mark.long
def test_without_the_rig_file_no_margins_are_shown_and_it_is_said_why():
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        panel = app.view.query_one(Margins)
        assert "design minimum-variance" in told(panel)
        assert "--rig FILE" in told(panel)
        assert "phase margin" not in told(panel)

    assert commands(attached(scenario, size=(80, 24))) == []


@pytest.mark.long
def test_without_the_rig_file_no_sequence_is_checked_or_run_but_what_is_under_way_is_ended():
    async def scenario(app, pilot):
        await pressed(app, pilot, "4")
        assert "--rig FILE" in told(app.view.query_one(Printed))
        for number, keys in enumerate((["down", "d"], ["g"], ["tab", "down", "enter"]), 1):
            await pressed(app, pilot, *keys)
            assert not app.screen.is_modal
            assert notifications(app).count("--rig FILE") == number
        await pressed(app, pilot, "z")

    app = attached(scenario)
    assert commands(app) == []
    assert sent(app) == [SequenceControl(loop="right", action="end")]


# ---------------------------------------------------------------- with it


@pytest.mark.long
def test_margins_and_sequences_go_by_the_rig_file_that_was_given():
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        assert "phase margin" in told(app.view.query_one(Margins))
        await pressed(app, pilot, "4", "down", "d", "g")
        assert isinstance(app.screen, Confirm)
        await pressed(app, pilot, "y")

    assert commands(attached(scenario, rig=RIG)) == [
        ["design", "--json", "--loop", "right", *RIG, "--", "minimum-variance"],
        ["sequence", "dry-run", "jog.toml", *RIG, "--present", *KEY],
        ["sequence", "run", "jog.toml", *RIG, *KEY],
    ]


# ---------------------------------------------------------------- saved designs


@pytest.mark.long
def test_margins_of_a_saved_design_are_those_of_its_file():
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        panel = app.view.query_one(Margins)
        assert "design minimum-variance of mine.json" in told(panel)
        assert "phase margin" in told(panel)
        app.state.loop.state = made_anew
        panel.redraw()
        assert "computing its margins" in told(panel)  # and not the margins of the other

    (made_anew,) = FakeSupervisor().message().loops
    app = attached(scenario, rig=RIG, key=[], controller_file="/rigs/mine.json")
    assert commands(app) == [["design", "--json", "--loop", "right", *RIG, "--", "/rigs/mine.json"]]


@pytest.mark.long
def test_a_file_on_another_machine_is_not_looked_for_on_this_one():
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        assert "margins are not known" in told(app.view.query_one(Margins))
        assert "phase margin" not in told(app.view.query_one(Margins))

    assert commands(attached(scenario, rig=RIG, controller_file="/rigs/mine.json")) == []


# ---------------------------------------------------------------- designs by other means


async def on_loop(app, pilot):
    await pressed(app, pilot, "3")


def learning(design_json):
    return LearningState(setting="on", state="in force", design_json=design_json)


@pytest.mark.long
def test_margins_and_error_budget_of_a_learnt_design_are_by_its_parameters():
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        assert "phase margin" in told(app.view.query_one(Margins))
        assert "expected" in told(app.view.query_one(ErrorBudget))

    app = attached(scenario, rig=RIG, controller="learnt", learning=learning(LEARNT_JSON))
    assert commands(app) == [["design", "--json", "--loop", "right", *RIG, "--", LEARNT_JSON]]


@pytest.mark.long
def test_a_design_for_the_measured_light_is_evaluated_with_the_light_that_the_console_sees():
    (command,) = commands(attached(on_loop, rig=RIG, noise_px=0.02))
    *rest, light, separator, name = command
    assert (rest, separator, name) == (
        ["design", "--json", "--loop", "right", *RIG, "--set"],
        "--",
        "minimum-variance",
    )
    key, _, flux_dn = light.partition("=")
    assert key == "loops.right.star_flux_dn"
    assert float(flux_dn) == pytest.approx(27_900.0, rel=0.01)


@pytest.mark.parametrize(
    "told_design",
    [
        {"controller": "/home/anna/mine.py"},
        pytest.param({"controller": "../../tmp/x.json"}, marks=pytest.mark.long),
        {"controller": "--plot=x.png"},
        {"controller": "learnt", "learning": learning("{" + 60_000 * " ")},
    ],
    ids=["a program", "a file", "an option", "very long"],
)
def test_what_a_supervisor_says_becomes_no_path_and_no_option(told_design):
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        assert "cannot evaluate the design" in told(app.view.query_one(Margins))

    assert commands(attached(scenario, rig=RIG, **told_design)) == []


@pytest.mark.long
def test_a_name_that_stands_for_no_design_is_a_problem_and_no_design(monkeypatch):
    async def scenario(app, pilot):
        await pressed(app, pilot, "3")
        assert "bound is not a design" in told(app.view.query_one(Margins))

    monkeypatch.setattr(FakeJob, "text", lambda _: json.dumps({"residual_px": 0.013}))
    attached(scenario, rig=RIG, controller="bound")


@pytest.mark.parametrize("printed", ["", '"stable": true}'])
def test_figures_of_a_design_that_are_no_json_are_a_problem(printed):
    figures = DesignFigures()
    figures.accept(DesignInUse("right", "integrator"), printed, 0)
    assert figures.problem.startswith("fitctl design printed no JSON: ")
