"""What `fitctl demo --headless` prints of a loop that does not hold at its end."""

import math

import pytest

from fitctl.commands.try_out.demo import _summary_text

COUNTS = {"frames": 9, "frames_lost": 0, "late_ticks": 0, "records_lost": 0, "machine_stalls": 0}
NONE = {"az": math.nan, "el": math.nan}
STAR = {"vernier_s": math.nan, "rms_px": NONE, "measured_rms_px": NONE, "rms_arcsec": NONE}
BEAM = {"locked_s": math.nan, "rms_arcsec": NONE}


@pytest.mark.parametrize(("held", "of_kind"), [("star", STAR), ("beam", BEAM)])
def test_what_was_never_reached_or_measured_is_said_in_words(held, of_kind):
    result = COUNTS | {"log": "a.mcap", "acquired_s": 7.8, "judged_s": 0.0} | of_kind

    text = _summary_text("right", result)

    assert f"{held} found after          7.8 s" in text
    assert "never" in text
    assert f"not measured: the {held} is not held at the end" in text
    assert "nan" not in text
