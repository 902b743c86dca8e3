"""docs/sequences.md is true: its tables, its file and its programs."""

import os
import tomllib
from pathlib import Path

import pytest
from documents import between, blocks
from step_tables import common_keys, step_keys

from fitctl.config import default_rig_path, load_rig
from fitctl.messages import endpoints, running
from fitctl.sequences.behaviours.table import problems
from fitctl.sequences.files import parse_yaml
from fitctl.sequences.reading import sequence_from_document


def shown(language):
    found = [block for block in blocks(language) if block.document.name == "sequences.md"]
    assert found
    return found


def test_the_tables_are_those_of_the_steps():
    assert between("sequences.md", "sequence-common") == common_keys()
    assert between("sequences.md", "sequence-steps") == step_keys()


@pytest.mark.parametrize("block", [*shown("TOML"), *shown("yaml")], ids=str)
def test_a_sequence_that_is_shown_is_well(block):
    yaml = block.language == "yaml"
    document = parse_yaml(block.text, Path(str(block))) if yaml else tomllib.loads(block.text)
    sequence = sequence_from_document(document, str(block))

    rig = load_rig(default_rig_path())
    assert [problem for step in sequence.steps for problem in problems(step, rig)] == []


@pytest.fixture
def nothing_runs(monkeypatch, tmp_path):
    """No supervisor runs, whatever this machine does beside the test."""
    monkeypatch.delenv("FITCTL_RIG", raising=False)
    monkeypatch.setattr(endpoints, "_own_folder", lambda: tmp_path)
    monkeypatch.setattr(running, "supervisor_names", lambda: f"fitctl-test:{os.getpid()}:")


@pytest.mark.long
@pytest.mark.parametrize("block", shown("python"), ids=str)
def test_a_program_that_is_shown_runs(block, nothing_runs, capsys):
    names, program = {}, compile(block.text, str(block), "exec")

    if "ConnectionError" in block.text:
        with pytest.raises(SystemExit) as end:
            exec(program, names)
        assert f"ConnectionError: {end.value.code}\n" in [found.text for found in shown("text")]
        return
    exec(program, names)

    assert names["held"]["rms_az_px"] < 0.1
    assert "nan" not in capsys.readouterr().out
