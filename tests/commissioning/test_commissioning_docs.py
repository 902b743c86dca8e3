"""docs/commissioning.md has every step as the table has it, and every entry of the catalogue."""

from miswired.catalogue import CATALOGUE
from miswired.report import PAGE, steps_table

TEXT = PAGE.read_text()


def test_the_page_has_the_table_of_steps():
    assert steps_table() in TEXT


def test_the_page_has_every_rig_that_is_wired_wrongly():
    rows = [
        line.split(" | ")[0].removeprefix("| ") for line in TEXT.splitlines() if line[:2] == "| "
    ]
    assert not [entry.name for entry in CATALOGUE if entry.name not in rows]
    assert len({entry.name for entry in CATALOGUE}) == len(CATALOGUE) >= 45
