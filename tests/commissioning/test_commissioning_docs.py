"""docs/commissioning.md has every step as the table has it, and every entry of the catalogue."""

import pytest
from miswired.catalogue import CATALOGUE
from miswired.report import PAGE, steps_table

from fitctl.commissioning.tasks import tasks_of
from fitctl.config import default_rig_path, load_rig

TEXT = PAGE.read_text()


def test_the_page_has_the_table_of_steps():
    assert steps_table() in TEXT


def test_the_page_has_every_rig_that_is_wired_wrongly():
    rows = [
        line.split(" | ")[0].removeprefix("| ") for line in TEXT.splitlines() if line[:2] == "| "
    ]
    assert not [entry.name for entry in CATALOGUE if entry.name not in rows]
    assert len({entry.name for entry in CATALOGUE}) == len(CATALOGUE) >= 45


@pytest.mark.parametrize("entry", CATALOGUE, ids=lambda entry: entry.name)
def test_mocks_can_be_wired_as_an_entry_says_and_its_steps_exist(entry):
    rig = load_rig(default_rig_path().with_name(entry.rig), entry.wrong)
    steps = {part for task in tasks_of(rig) for part in (task.name, task.name.rpartition(".")[2])}
    assert {entry.step, *entry.only} <= steps
    assert entry.loop in rig.loops
