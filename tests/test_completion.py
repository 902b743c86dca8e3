"""Tab in a real shell: the completion script that fitctl itself gives, asked by bash."""

import os
import shutil
import subprocess
import sys

import pytest

from fitctl.commands.fault import kinds
from fitctl.config import CONTROLLERS, default_rig_path
from fitctl.sequences.files import shipped_sequences

pytestmark = pytest.mark.skipif(not shutil.which("bash"), reason="needs bash")
ASK = """
source ./script
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
$(complete -p fitctl | sed 's/.*-F \\([^ ]*\\).*/\\1/') fitctl
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script():
    """What `fitctl --install-completion bash` has bash read."""
    return fitctl_says("--show-completion", "bash")


def fitctl_says(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "fitctl", *arguments],
        env=os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    ).stdout


@pytest.fixture
def tab(tmp_path, monkeypatch, script):
    """What bash offers at Tab after some words, of which the last is begun."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script").write_text(script)
    program = tmp_path / "bin" / "fitctl"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m fitctl "$@"\n')
    program.chmod(0o755)
    (tmp_path / "notes.toml").write_text("[rig]\n")
    shutil.copy(default_rig_path(), tmp_path / "night.toml")

    def ask(*words):
        done = subprocess.run(
            ["bash", "--norc", "-c", ASK, "bash", "fitctl", *words],
            env=os.environ | {"PATH": f"{program.parent}:{os.environ['PATH']}"},
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        return done.stdout.split()

    return ask


def test_commands_are_offered(tab):
    assert tab("st") == ["status"]


def test_rig_files_are_offered_and_no_others(tab):
    assert tab("check", "--rig", "n") == ["night.toml"]


def test_shipped_sequences_are_offered(tab):
    assert tab("sequence", "run", "") == [path.stem for path in shipped_sequences()]


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("fault", "set", "right."), ["right.drive", "right.dac", "right.mdt693"]),
        (("fault", "set", "right.mdt693", ""), sorted(kinds()["mdt693"])),
        (("run", "--controller", ""), sorted(CONTROLLERS)),
        (("send", "--rig", "night.toml", "--loop", ""), ["right"]),
    ],
)
def test_names_are_offered(tab, words, offered):
    assert sorted(tab(*words)) == sorted(offered)


def test_a_rig_file_with_a_mistake_is_passed_over_in_silence(tab, tmp_path):
    (tmp_path / "wrong.toml").write_text("[loops.right]\nnonsense = 1\n")

    assert tab("fault", "set", "--rig", "wrong.toml", "r") == []
