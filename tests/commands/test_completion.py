"""Tab in real shells: the completion script that fitctl itself gives, asked by bash, zsh and fish."""

import functools
import os
import shutil
import subprocess
import sys

import pytest

from fitctl.commands.shared.fault_kinds import kinds
from fitctl.config import CONTROLLERS, default_rig_path
from fitctl.sequences.files import shipped_sequences

pytestmark = pytest.mark.long

# Each sources ./script and prints what it offers at Tab after its arguments, one a line.
BASH = """
source ./script
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
$(complete -p fitctl | sed 's/.*-F \\([^ ]*\\).*/\\1/') fitctl
printf '%s\\n' "${COMPREPLY[@]}"
"""
FISH = """
source ./script
complete -C "$argv" | sed 's/\\t.*//'
"""
# zsh completes nothing but what is typed: an interactive one, which tells what its completers add.
ZSH = """
zmodload zsh/zpty
zpty tab zsh -f -i
zpty -w tab 'source ./typed; print "<rea""dy>"'
zpty -r tab answer '*<ready>*'
zpty -w -n tab "$*"$'\\t'
zpty -r tab answer '*<end>*'
print -r -- "$answer" | tr -d '\\r' | sed -n 's/^offered: //p'
"""
ZSH_TYPED = """
autoload -U compinit && compinit -u -D
source ./script
compadd() {
  if [[ ${@[1,(i)(-|--)]} != *-(O|A|D)\\ * ]]; then
    typeset -a found
    builtin compadd -A found "$@"
    print -lr -- "" "offered: "$^found
  fi
  builtin compadd "$@"
}
finish() { print "<end>"; exit }
comppostfuncs=(finish)
bindkey '^I' complete-word
"""
SHELLS = {
    "bash": ("bash", "--norc", "-c", BASH, "bash"),
    "zsh": ("zsh", "-f", "-c", ZSH, "zsh"),
    "fish": ("fish", "--no-config", "-c", FISH),
}
in_every_shell = pytest.mark.parametrize("shell", SHELLS)


@functools.cache
def script(shell):
    """What `fitctl --install-completion` has a shell read."""
    return subprocess.run(
        [sys.executable, "-m", "fitctl", "--show-completion", shell],
        env=os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    ).stdout


@pytest.fixture
def tab(tmp_path, monkeypatch):
    """What a shell offers at Tab after some words, of which the last is begun; in no order."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "typed").write_text(ZSH_TYPED)
    program = tmp_path / "bin" / "fitctl"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m fitctl "$@"\n')
    program.chmod(0o755)
    (tmp_path / "notes.toml").write_text("[rig]\n")
    shutil.copy(default_rig_path(), tmp_path / "night.toml")

    def ask(*words, shell="bash"):
        if not shutil.which(shell):
            pytest.skip(f"{shell} is not installed")
        (tmp_path / "script").write_text(script(shell))
        done = subprocess.run(
            [*SHELLS[shell], "fitctl", *words],
            env=os.environ
            | {"HOME": str(tmp_path), "PATH": f"{program.parent}:{os.environ['PATH']}"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        return sorted(done.stdout.split())

    return ask


@in_every_shell
def test_commands_are_offered(tab, shell):
    assert tab("st", shell=shell) == ["status"]


@in_every_shell
def test_rig_files_are_offered_and_no_others(tab, shell):
    assert tab("check", "--rig", "n", shell=shell) == ["night.toml"]


@in_every_shell
def test_what_is_offered_goes_by_the_words_before(tab, shell):
    assert tab("fault", "set", "right.mdt693", "", shell=shell) == sorted(kinds()["mdt693"])


def test_shipped_sequences_are_offered(tab):
    assert tab("sequence", "run", "") == sorted(path.stem for path in shipped_sequences())


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("fault", "set", "right."), ["right.drive", "right.dac", "right.mdt693"]),
        (("run", "--controller", ""), CONTROLLERS),
        (("send", "--rig", "night.toml", "--loop", ""), ["right"]),
    ],
)
def test_names_are_offered(tab, words, offered):
    assert tab(*words) == sorted(offered)


def test_a_rig_file_with_a_mistake_is_passed_over_in_silence(tab, tmp_path):
    (tmp_path / "wrong.toml").write_text("[loops.right]\nnonsense = 1\n")

    assert tab("fault", "set", "--rig", "wrong.toml", "r") == []
