"""What `fitctl simulate --runs` prints of figures that no run has."""

import math

from fitctl.commands.design.simulate import _row
from fitctl.simulation.campaign import Statistics


def test_a_figure_that_no_run_has_is_a_dash():
    none = Statistics(math.nan, {"50": math.nan}, math.nan)
    some = Statistics(1.0, {"50": 1.0}, 2.0)

    assert _row("true RMS az, px", none, 4, 1.0).split()[4:] == ["-", "-", "-"]
    assert _row("true RMS az, px", some, 1, 1.0).split()[4:] == ["1.0", "1.0", "2.0"]
