"""What each controller did about the disturbance."""

import dataclasses
import json

import numpy as np
import pytest

from fitctl.commands.shared.opened import opened_loop
from fitctl.config import ConfigError
from fitctl.report.rejection import held_by_controller, last_design

RIGHT = "right"
EVIL = "\ud800\0\x1b[31m\nFORGED"
PLAIN = r"\ud800\u0000\u001b[31m\nFORGED"


@pytest.fixture
def named(findings):
    """The run that held its star, by a design of a name that no terminal and no font can have."""
    gathered = findings.gathered
    (log,) = gathered.run.logs
    design = json.dumps({"name": EVIL, "parameters": 7})
    metadata = log.metadata | {"designs": {"right": design}}
    run = gathered.run._replace(logs=(dataclasses.replace(log, metadata=metadata),))
    return dataclasses.replace(gathered, run=run)


def test_a_controller_of_a_log_has_a_name_that_can_be_printed_and_drawn(named, findings):
    change = {"loop": "right", "time_s": 1e9, "source": EVIL, "target": EVIL, "design_json": ""}

    for changes in ([], [change]):
        gathered = dataclasses.replace(named, changes=changes)
        (held,) = held_by_controller(gathered, "right", findings.loops["right"].selection)
        assert held.controller == PLAIN


def test_an_error_about_a_design_of_a_log_is_one_line(named):
    change = {"loop": "right", "time_s": 1e9, "source": "eq20", "target": EVIL + "2"}

    with pytest.raises(ConfigError) as caught:
        last_design(dataclasses.replace(named, changes=[change]), "right")

    assert PLAIN in str(caught.value)
    assert str(caught.value).isprintable()


def changed(findings, after_s):
    """The run, with the controller changed so long after the star was held; and from when on."""
    loop = findings.loops[RIGHT]
    change_s = loop.ticks["time_s"][loop.selection.rows[0]] + after_s
    change = {"loop": RIGHT, "time_s": change_s, "source": "fslq", "target": "eq20"}
    return dataclasses.replace(findings.gathered, changes=[change]), change_s


def test_the_error_under_the_present_design_is_that_of_its_own_frames(findings):
    gathered, change_s = changed(findings, after_s=10.0)
    opened = opened_loop(gathered, RIGHT)
    ticks, rows = findings.loops[RIGHT].ticks, opened.selection.rows
    later = rows[ticks["time_s"][rows] >= change_s]
    errors_px = np.array([ticks[f"error_{axis}_px"][later] for axis in ("az", "el")])

    assert 0 < len(later) < len(rows)
    assert opened.measured_px == pytest.approx(np.sqrt(np.mean(errors_px**2, axis=1)))


def test_a_design_that_came_after_the_last_frame_has_no_error(findings):
    gathered, _ = changed(findings, after_s=1e9)

    assert opened_loop(gathered, RIGHT).measured_px is None
