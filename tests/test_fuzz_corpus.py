"""What fuzzing once found is tried again, and a few hundred bytes of chance beside it."""

import importlib.util
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

FUZZ = Path(__file__).parents[1] / "fuzz"
TARGETS = sorted(path.stem for path in FUZZ.glob("fuzz_*.py"))
FOUND = sorted(FUZZ.glob("corpus/*/*"))


def target(name):
    spec = importlib.util.spec_from_file_location(name, FUZZ / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.TestOneInput


def test_every_device_has_a_target():
    wanted = {"fuzz_cia402", "fuzz_gige", "fuzz_labjack_t7", "fuzz_mdt693", "fuzz_modbus_dac"}
    assert wanted <= set(TARGETS)


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_was_found_is_mended(path):
    target(f"fuzz_{path.parent.name}")(path.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_leave_parsers_alive(name):
    one_input = target(name)

    @settings(max_examples=100)
    @given(data=st.binary(max_size=300))
    def run(data):
        one_input(data)

    run()
