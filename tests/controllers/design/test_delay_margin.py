"""How much more delay the paper's compensator bears."""

import pytest

from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.sampled import sampled_loop


@pytest.mark.parametrize(("more_s", "stable"), [(0.0049, True), (0.0051, False)])
def test_eq20_is_stable_up_to_5_ms_more_delay(fit, changed, more_s, stable):
    later = changed(fit, delay_s=more_s)

    assert sampled_loop(DESIGNS["eq20"](fit), later).stable is stable
