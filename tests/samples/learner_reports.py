"""What a learner would report of a night with a line at 6 Hz, as far as a loop is concerned."""

import dataclasses
import functools

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Line, basis
from fitctl.controllers.design.document import parameters_json
from fitctl.controllers.design.margins import design_with_margins
from fitctl.messages.commands import LearnerReport

SHAKEN = (
    "loops.right.vernier.controller=minimum-variance",
    "plant.loops.right.lines=[{frequency_hz=6.0,rms_px=0.0707,direction_deg=45.0,damping=0.005,"
    "drift_hz_per_min=0.0}]",
)
# The design for a line of 0.05 px at 6 Hz, on the rig's air and noise.
LINE = Line(frequency_hz=6.0, damping=0.01, rms_px=0.05)
PAPER = basis(load_rig(default_rig_path()), "right")


@functools.cache
def learnt_json(*lines):
    return parameters_json(design_with_margins(dataclasses.replace(PAPER, lines=lines)))


def report(*, worth_it=True, lines=(LINE,), design_json="", **values):
    values = {
        "present_px": 0.1,
        "learnt_px": 0.024,
        "bound_px": 0.0236,
        "learnt_camera_px": 0.026,
        "measured_px": 0.1,
    } | values
    return LearnerReport(
        loop="right",
        design_json=design_json or learnt_json(*lines),
        text="a line at 6 Hz",
        evaluated_s=60.0,
        worth_it=worth_it,
        **values,
    )
