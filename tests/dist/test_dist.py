"""Wheel and sdist as a stranger gets them: built, installed into fresh environments, run from elsewhere.

The wheel is tried on each Python from 3.11 on that this machine has: on the path, or of pyenv or uv.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

import pytest
from documents import ROOT
from tutorial import walk_through

pytestmark = [pytest.mark.dist, pytest.mark.timeout(1200)]
NEAR = "plant.loops.right.star_offset_sky_arcsec_max=5.0"  # found at once


def run(*words, cwd, timeout_s=600, statuses=(0,), **environment):
    """Run a command without this environment's Python; its output."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        list(map(str, words)),
        cwd=cwd,
        env=clean | environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode in statuses, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def built(source, folder, kind):
    """A distribution made of a source tree."""
    run(sys.executable, "-m", "hatchling", "build", "-d", folder, "-t", kind, cwd=source)
    (made,) = folder.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return built(ROOT, tmp_path_factory.mktemp("wheel"), "wheel")


def pythons():
    """A Python of each version from 3.11 on; the one that runs the tests is the first."""
    home = Path.home()
    candidates = [
        Path(sys.executable),
        *(Path(found) for n in range(11, 30) if (found := shutil.which(f"python3.{n}"))),
        *home.glob(".pyenv/versions/3.*/bin/python3"),
        *home.glob(".local/share/uv/python/*/bin/python3"),
    ]
    found = {}
    for python in candidates:
        asked = subprocess.run(
            [python, "--version"], capture_output=True, text=True, timeout=60, check=False
        )
        version = re.match(r"Python 3\.(\d+)\.\d+$", asked.stdout)  # no release candidates
        if asked.returncode == 0 and version and int(version[1]) >= 11:
            found.setdefault(f"3.{version[1]}", python)
    return found


PYTHONS = pythons()
QUIET = ("--quiet", "--disable-pip-version-check")


@pytest.fixture(scope="module", params=PYTHONS)
def installed(request, wheel, tmp_path_factory):
    """The folder of programs of an environment that has the wheel and what it asks for."""
    folder = tmp_path_factory.mktemp("fresh") / "venv"
    run(PYTHONS[request.param], "-m", "venv", folder, cwd=ROOT)
    run(folder / "bin" / "python", "-m", "pip", "install", *QUIET, wheel, cwd=folder)
    run(folder / "bin" / "python", "-m", "pip", "check", cwd=folder)
    return folder / "bin"


def test_the_sdist_builds_the_same_wheel(wheel, tmp_path):
    for name in ("sdist", "unpacked", "again"):
        (tmp_path / name).mkdir()
    with tarfile.open(built(ROOT, tmp_path / "sdist", "sdist")) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (source,) = (tmp_path / "unpacked").iterdir()
    again = built(source, tmp_path / "again", "wheel")

    with zipfile.ZipFile(wheel) as one, zipfile.ZipFile(again) as other:
        assert sorted(one.namelist()) == sorted(other.namelist())


def test_the_wheel_has_rigs_sequences_layouts_and_the_systemd_unit(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())

    for folder, inside in (
        ("rigs", "fitctl/rigs"),
        ("sequences", "fitctl/shipped_sequences"),
        ("layouts", "fitctl/layouts"),
    ):
        assert {f"{inside}/{path.name}" for path in (ROOT / folder).iterdir()} <= names
    assert any(name.endswith("share/fitctl/systemd/fitctl@.service") for name in names)
    assert not [name for name in names if name.startswith(("tests/", "docs/"))]


def test_the_wheel_has_the_version_of_the_code(wheel):
    text = (ROOT / "fitctl" / "__init__.py").read_text()
    version = re.search(r'__version__ = "(.+)"', text)[1]

    assert wheel.name == f"fitctl-{version}-py3-none-any.whl"


def test_pipx_installs_it(wheel, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "tools", cwd=tmp_path)
    run(tmp_path / "tools" / "bin" / "pip", "install", *QUIET, "pipx", cwd=tmp_path)
    own = {"PIPX_HOME": str(tmp_path / "pipx"), "PIPX_BIN_DIR": str(tmp_path / "bin")}
    run(tmp_path / "tools" / "bin" / "pipx", "install", wheel, cwd=tmp_path, **own)

    assert wheel.name.split("-")[1] in run(tmp_path / "bin" / "fitctl", "--version", cwd=tmp_path)
    assert "well" in run(tmp_path / "bin" / "fitctl", "check", cwd=tmp_path)


def test_it_says_what_to_do_next_and_finds_its_files(installed, tmp_path):
    fitctl = installed / "fitctl"

    assert "fitctl demo" in run(fitctl, cwd=tmp_path)
    assert "acquire" in run(fitctl, "sequence", "list", cwd=tmp_path)
    run(fitctl, "init", "mine.toml", "--mocks", cwd=tmp_path)
    assert "well" in run(fitctl, "check", "--rig", "mine.toml", cwd=tmp_path)


def test_the_demo_runs_and_logs(installed, tmp_path):
    with tempfile.TemporaryDirectory(prefix="fitctl-") as runtime:  # short, for a socket's path
        out = run(
            installed / "fitctl",
            *("demo", "--headless", "--duration", "20", "--json", "--set", NEAR),
            cwd=tmp_path,
            statuses={0, 1},  # how well a busy machine holds the star is no matter of packaging
            XDG_RUNTIME_DIR=runtime,
        )

    summary = json.loads(out.splitlines()[-1])
    assert summary["acquired_s"] > 0
    assert summary["frames"] > 500
    assert "finished" in run(installed / "fitctl", "log", "info", summary["log"], cwd=tmp_path)


def test_the_tutorial_runs_as_typed(installed, tmp_path):
    where = "from fitctl.config import default_rig_path; print(default_rig_path())"
    rig = run(installed / "python", "-c", where, cwd=tmp_path).strip()
    (tmp_path / "work").mkdir()

    walk_through(tmp_path / "work", installed, rig)
