import pytest
from samples.report_samples import held_and_jogged, record

from fitctl.report.findings import find
from fitctl.report.run import find_run


@pytest.fixture(scope="session")
def held(rig, tmp_path_factory):
    """A simulation that held its star, and its log."""
    path = tmp_path_factory.mktemp("held") / "held.mcap"
    return record(rig, path, held_and_jogged), path


@pytest.fixture(scope="session")
def findings(held):
    return find(find_run([held[1]]))
