"""The electronic data sheet tells other CANopen tools what the mock drive truly has."""

import asyncio
from importlib.resources import files

import canopen
import pytest
from canopen import objectdictionary as od
from instruments.mock_bench import ToldMotors

from fitctl import config
from fitctl.mocks.cia402.dictionary import SdoAbortError
from fitctl.mocks.cia402.drive import Cia402DriveMock

EDS = str(files("fitctl.mocks.cia402") / "fit_drive.eds")
TYPES = {
    "b": od.INTEGER8,
    "h": od.INTEGER16,
    "i": od.INTEGER32,
    "B": od.UNSIGNED8,
    "H": od.UNSIGNED16,
    "I": od.UNSIGNED32,
    "s": od.VISIBLE_STRING,
}


@pytest.fixture(scope="module")
def real():
    """The dictionary of a drive that was just started."""
    siderostat = config.load_rig(config.default_rig_path()).loops["right"].siderostat

    async def started():
        mock = Cia402DriveMock(siderostat, ToldMotors(), port=0)
        await mock.start()
        await mock.stop()
        return mock.dictionary

    return asyncio.run(started())


@pytest.fixture(scope="module")
def sheet():
    """All entries of the data sheet by index and subindex, for node 1."""
    entries = {}
    for item in canopen.import_od(EDS, node_id=1).values():
        parts = [item] if isinstance(item, od.ODVariable) else item.subindices.values()
        entries |= {(part.index, part.subindex): part for part in parts}
    return entries


def test_it_lists_the_objects_that_there_are(sheet, real):
    assert set(sheet) == set(real)


def test_types_access_and_mapping_are_the_real_ones(sheet, real):
    for key, entry in real.items():
        told = sheet[key]
        assert told.data_type == TYPES[entry.code], told.name
        assert told.readable == (entry.read is not None), told.name
        assert told.writable == (entry.write is not None), told.name
        assert told.pdo_mappable == entry.mappable, told.name


def test_defaults_are_what_a_started_drive_answers(sheet, real):
    for key, entry in real.items():
        try:
            value = entry.read()
        except SdoAbortError:
            continue  # an error history without errors
        assert sheet[key].default == value, sheet[key].name


def test_constants_are_said_to_be_constant(sheet):
    assert sheet[0x1018, 4].access_type == "const"
    assert sheet[0x6041, 0].access_type == "ro"
