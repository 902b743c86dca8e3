"""What a soak would say of an instrument that leaks, loses or does not come back."""

import random
from itertools import islice

import numpy as np
import pytest
from samples.log_samples import RUN_INFO, SETTINGS, WALL_S, filled, tick

from benchmarks.soak import growth, logs, strikes
from fitctl.commands.shared.fault_kinds import kinds
from fitctl.logging.records import Event, RecorderStatus
from fitctl.logging.writer import LogWriter


def grown(per_hour, lived_s=3600.0, noise=2.0):
    """Growth of a quantity with a steep beginning, noise of several MB, and an outlier."""
    time_s = np.arange(0.0, lived_s, growth.SAMPLE_S)
    value = 100 + per_hour * time_s / 3600 + 50 * (1 - np.exp(-time_s / 60))
    value += noise * np.random.default_rng(1).standard_normal(len(time_s))
    value[len(value) // 2] += 500
    return growth._growth(time_s, value)


@pytest.mark.parametrize("per_hour", [0.0, 12.0, -5.0])
def test_growth_is_that_after_the_warm_up_whatever_a_single_sample_says(per_hour):
    found = grown(per_hour)
    assert found.low <= per_hour <= found.high
    assert found.high - found.low < 3
    assert found.most > 600


def test_a_process_that_lived_too_briefly_has_no_growth():
    found = grown(12.0, lived_s=200.0)
    assert np.isnan(found.per_hour)
    assert found.first == pytest.approx(145, abs=15)


@pytest.fixture
def folder(tmp_path):
    """Two logs of one run; the recorder of the first was killed before it could confirm its last two."""
    status = filled(RecorderStatus)
    first = [RUN_INFO, *map(tick, range(5)), status]
    second = [RUN_INFO, tick(3), tick(4), *map(tick, range(5, 9)), status]
    second.append(Event(time_s=1.0, severity="info", source="recorder", message="a.mcap: deleted"))
    killed = LogWriter(tmp_path / "a.mcap", SETTINGS)
    for record in first:
        killed.write(record, WALL_S)
    killed.flush()
    (tmp_path / "kept").write_bytes((tmp_path / "a.mcap").read_bytes())
    killed.close()
    (tmp_path / "kept").replace(tmp_path / "a.mcap")
    with LogWriter(tmp_path / "b.mcap", SETTINGS) as log:
        for record in second:
            log.write(record, WALL_S)
    return tmp_path


@pytest.mark.long
def test_records_count_once_whatever_two_files_hold_and_the_recorders_own_do_not(folder):
    audit = logs.Audit(folder)
    audit.finish()
    assert (audit.files, audit.cut, audit.problems) == (2, 1, [])
    assert (audit.written, audit.twice) == (9, 2)


def test_a_log_that_is_not_whole_is_a_problem(folder):
    path = folder / "b.mcap"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert any("b.mcap" in problem for problem in logs.read(path).problems)


def test_every_fault_of_the_default_rigs_devices_strikes_once_before_any_strikes_again():
    names = [strike.name for strike in strikes.STRIKES]
    wanted = {"camera": "camera", "right.drive": "drive", "right.dac": "dac"}
    wanted["right.mdt693"] = "mdt693"
    assert {f"{device} {kind}" for device, of in wanted.items() for kind in kinds()[of]} < set(
        names
    )
    struck = [strike.name for strike in islice(strikes.shuffled(random.Random(3)), 2 * len(names))]
    assert sorted(struck[: len(names)]) == sorted(struck[len(names) :]) == sorted(names)
