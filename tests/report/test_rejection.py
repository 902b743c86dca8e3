"""What each controller did about the disturbance."""

import dataclasses
import json

import pytest

from fitctl.config import ConfigError
from fitctl.report.rejection import held_by_controller, last_design

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
