"""What the documents say of the console's panels is what the panels show."""

import math
import re

import msgspec
import pytest
from documents import FENCED, ROOT
from samples.learner_reports import report

from fitctl.messages.telemetry import LearningState
from fitctl.tui.widgets.margins import learning_lines
from tests.instruments.fake_supervisor import FakeSupervisor

EVERY_STATE = {
    "collecting frames in VERNIER": {"state": "collecting"},
    "no other design would leave clearly less": {"state": "kept"},
    "the model does not explain the frames: kept": {"state": "kept", "fits": False},
    "nothing could be learnt; the design is kept": {"state": "failed"},
    "advice: 0.0240 px instead of 0.1000": {"state": "advice"},
    "on frames 0.0271 px, expected 0.0262": {
        "state": "in force",
        "measured_px": 0.0271,
        "expected_px": 0.0262,
        "before_px": 0.0978,
    },
    "returned to the previous design": {"state": "fell back"},
}


def shown(fits=True, before_px=math.nan, **values):
    """Names and texts of the lines in one state."""
    made = None if values["state"] == "collecting" else report(design_json="{}", fits=fits)
    loop = next(iter(FakeSupervisor().message().loops))
    learning = LearningState(
        setting="on", text="a night", report=made, before_px=before_px, **values
    )
    lines = learning_lines(msgspec.structs.replace(loop, learning=learning), 100)
    return {line[0].text.strip(): line[1].text for line in lines}


@pytest.mark.parametrize("text", EVERY_STATE)
def test_the_line_of_what_was_learnt_is_documented(text):
    assert shown(**EVERY_STATE[text])["learning"] == text
    assert f"| `{text}` |" in (ROOT / "docs/console.md").read_text()


def test_each_line_of_what_was_learnt_is_described():
    names = {name for values in EVERY_STATE.values() for name in shown(**values)}
    section = (ROOT / "docs/console.md").read_text().split("## Loop\n")[1].split("\n## ")[0]

    assert names == {"learning", "before", "to apply", "night"}
    assert names <= set(re.findall(r"`([^`\n]+)`", FENCED.sub("", section)))
