"""docs/tutorial.md, typed as it stands, with the fitctl of this checkout."""

import sys

import pytest
from tutorial import walk_through

from fitctl.config import default_rig_path

pytestmark = [pytest.mark.terminal, pytest.mark.timeout(600)]


def test_every_command_of_the_tutorial_does_what_it_says(tmp_path):
    program = tmp_path / "bin" / "fitctl"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m fitctl "$@"\n')
    program.chmod(0o755)
    (tmp_path / "work").mkdir()

    walk_through(tmp_path / "work", program.parent, default_rig_path())
