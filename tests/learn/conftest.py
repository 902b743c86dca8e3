"""The paper's night, and the design for it."""

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.minimum_variance import design_minimum_variance


@pytest.fixture(scope="session")
def paper():
    return basis(load_rig(default_rig_path()), "right")


@pytest.fixture(scope="session")
def fixed(paper):
    """The design for the paper's night."""
    return design_minimum_variance(paper)
