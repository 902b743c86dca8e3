import dataclasses
import io
import os
import zipfile

import numpy as np
import pytest

from fitctl.config import lay_over, rig_from_document
from fitctl.identify import response
from fitctl.identify.errors import IdentifyError
from fitctl.identify.modes_fit import modes_response
from fitctl.mocks.detector import DetectorBench
from fitctl.model import hysteresis, structure
from fitctl.model.detector import DETECTOR_RANGE_V, SAMPLE_RATE_HZ

pytestmark = pytest.mark.long

AZ, EL = 0, 1


def db(ratio):
    return 20 * np.log10(np.abs(ratio))


@pytest.fixture(scope="module")
def records(rig):
    return response.measure(DetectorBench(rig, "right"))


@pytest.fixture(scope="module")
def result(records):
    return response.analyse(records, "right")


@pytest.fixture(scope="module")
def local_gain(rig):
    """What hysteresis leaves of a slow swing of 7.2 arcsec: the fundamental, complex."""
    fsm, truth = rig.loops["right"].fsm, rig.plant.loops["right"].hysteresis
    half_v, gains = hysteresis.half_widths_v(truth), hysteresis.stack_gains(truth, fsm)
    swing_v = response.AMPLITUDE_RAD * fsm.stack_radius_m / fsm.stack_scale_m_per_v
    phase = 2 * np.pi * np.arange(4000) / 2000
    plays_v, displacement_m = np.zeros(len(half_v)), []
    for volts in swing_v * np.sin(phase):
        plays_v = hysteresis.play(plays_v, volts, half_v)
        displacement_m.append(plays_v @ gains)
    fundamental = np.mean(np.array(displacement_m[2000:]) * np.exp(-1j * phase[2000:])) * 2j
    return fundamental / swing_v / fsm.stack_scale_m_per_v


def test_the_response_is_the_plants_own_within_a_decibel_to_100_hz(rig, result, local_gain):
    band = result.frequency_hz <= 100
    assert result.frequency_hz[0] == pytest.approx(0.1)
    truth = local_gain * structure.frequency_response(
        rig.plant.loops["right"].structure, result.frequency_hz[band]
    )
    for axis in (AZ, EL):
        off_db = db(result.response[band, axis, axis] / truth[:, axis, axis])
        assert np.abs(off_db).max() < 0.1  # a tenth of what is asked


def test_the_modes_are_found_within_a_percent(rig, result):
    truth = rig.plant.loops["right"].structure
    assert [mode.frequency_hz.value for mode in result.fit.modes] == pytest.approx(
        truth.mode_hz, rel=1e-3
    )
    for mode in result.fit.modes:
        assert mode.damping.value == pytest.approx(truth.damping, rel=0.01)
        assert mode.participation.value == pytest.approx(truth.participation, rel=0.01)
    assert np.tan(result.fit.modes[0].angle_rad.value) == pytest.approx(truth.cross_axis, rel=0.01)


def test_the_cross_axis_is_silent_below_and_coupled_above_100_hz(result):
    slow, first = result.frequency_hz < 50, np.argmin(np.abs(result.frequency_hz - 330))
    assert db(result.response[slow, EL, AZ]).max() < -50
    assert db(result.response[first, EL, AZ]) > 0
    assert result.coherence[first, EL, AZ] > 0.99


def test_the_excited_axis_is_coherent_to_the_end(result):
    assert result.coherence[:, [AZ, EL], [AZ, EL]].min() > 0.98


def test_the_fit_goes_through_the_measured_response(result):
    band = result.frequency_hz > 10
    fitted = modes_response(result.fit, result.frequency_hz[band])
    off = np.abs(fitted - result.response[band])
    assert np.median(off / np.linalg.norm(fitted, axis=(1, 2))[:, None, None]) < 0.01
    assert result.fit.misfit < 0.02


def test_the_rig_file_then_knows_the_modes(rig, result):
    document = rig.model_dump()
    lay_over(document, result.fragment())
    found = rig_from_document(document, "test").loops["right"].fsm.structure
    assert found.mode_hz == pytest.approx([330, 470], rel=1e-3)


def test_the_operator_reads_modes_and_sees_a_plot(result, tmp_path):
    assert "mode 1: 330.0" in "\n".join(result.lines())
    result.draw().savefig(tmp_path / "response.png")
    assert (tmp_path / "response.png").stat().st_size > 1000


# ---------------------------------------------------------------- records from elsewhere


def columns_of(record, fsm, seconds):
    count = round(seconds * record.rate_hz)
    return {
        "time_s": 7.0 + np.arange(count) / record.rate_hz,
        "drive_v": 5.0 + record.drive_rad[:count] * fsm.stack_radius_m / fsm.stack_scale_m_per_v,
        "detector_az_v": record.detector_v[:count, AZ],
        "detector_el_v": record.detector_v[:count, EL],
    }


def test_one_axis_of_a_real_bench_is_read_from_a_file_and_tells_the_modes(rig, records, tmp_path):
    fsm = rig.loops["right"].fsm
    np.savez(tmp_path / "el.npz", **columns_of(records[EL], fsm, response.CHIRP_S))
    read = response.read_bench(tmp_path / "el.npz", fsm)
    assert read.axis == "el"
    assert read.rate_hz == pytest.approx(SAMPLE_RATE_HZ)
    result = response.analyse([read], "right")
    assert result.response.shape[1:] == (2, 1)
    assert [mode.frequency_hz.value for mode in result.fit.modes] == pytest.approx(
        [330, 470], rel=0.01
    )
    assert np.tan(result.fit.modes[0].angle_rad.value) == pytest.approx(0.3, rel=0.03)
    result.draw().savefig(tmp_path / "el.png")


def test_csv_reads_as_npz_does(rig, records, tmp_path):
    fsm = rig.loops["right"].fsm
    columns = columns_of(records[AZ], fsm, 0.5)
    np.savez(tmp_path / "az.npz", **columns)
    np.savetxt(
        tmp_path / "az.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=", ".join(columns),
        comments="",
    )
    csv, npz = (response.read_bench(tmp_path / name, fsm) for name in ("az.csv", "az.npz"))
    assert csv.axis == npz.axis == "az"
    assert csv.drive_rad == pytest.approx(npz.drive_rad, abs=1e-12)
    assert csv.detector_v == pytest.approx(npz.detector_v)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "time_s,drive_v\n0,1\n",
        "time_s,drive_v,detector_az_v,detector_el_v\n0,1,2,x\n",
        "time_s,drive_v,detector_az_v,detector_el_v\n0,1,2,nan\n1,1,2,3\n",
        "time_s,drive_v,detector_az_v,detector_el_v\n0,1e300,2,3\n1,1e308,2,3\n",
        "time_s,drive_v,detector_az_v,detector_el_v\n0,0,0,0\n1,0,0,0\n9,0,0,0\n",
    ],
)
def test_a_file_that_is_no_bench_record_is_refused_with_what_is_expected(rig, tmp_path, text):
    path = tmp_path / "bench.csv"
    path.write_text(text)
    with pytest.raises(
        IdentifyError, match=r"expected (NPZ or CSV with time_s|samples at a constant rate)"
    ):
        response.read_bench(path, rig.loops["right"].fsm)


def test_a_csv_file_may_begin_with_a_byte_order_mark_as_those_of_excel_do(rig, tmp_path):
    path = tmp_path / "bench.csv"
    rows = "0,1,2,3\n1,2,3,5\n2,3,4,7\n"
    path.write_text(f"time_s,drive_v,detector_az_v,detector_el_v\n{rows}", encoding="utf-8-sig")

    assert response.read_bench(path, rig.loops["right"].fsm).axis == "el"


def test_a_clipped_detector_is_refused(records):
    clipped = dataclasses.replace(
        records[AZ], detector_v=np.full_like(records[AZ].detector_v, DETECTOR_RANGE_V)
    )
    with pytest.raises(IdentifyError, match="the detector reached"):
        response.analyse([clipped, records[EL]], "right")


def test_a_short_record_is_refused(records):
    short = dataclasses.replace(
        records[AZ],
        drive_rad=records[AZ].drive_rad[:9999],
        detector_v=records[AZ].detector_v[:9999],
    )
    with pytest.raises(IdentifyError, match="expected at least 40 s"):
        response.analyse([short], "right")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("still", "named"), [("drive_rad", "drive_v"), ("detector_v", "the detector")]
)
def test_a_record_of_a_mirror_that_nothing_moves_is_refused_without_a_warning(
    records, still, named
):
    resting = dataclasses.replace(records[AZ], **{still: 0 * getattr(records[AZ], still)})

    with pytest.raises(IdentifyError, match=f"{named} does not change"):
        response.analyse([resting], "right")


def test_the_same_axis_twice_and_no_axis_are_refused(records):
    for given in ([records[AZ], records[AZ]], []):
        with pytest.raises(IdentifyError, match="expected one of az, of el, or one of each"):
            response.analyse(given, "right")


def test_a_mirror_without_resonance_is_refused(records):
    detector_v = np.column_stack([records[AZ].drive_rad * 5e4, 0 * records[AZ].drive_rad])
    detector_v += 1e-4 * np.random.default_rng(0).standard_normal(detector_v.shape)
    with pytest.raises(IdentifyError, match="no resonance"):
        response.analyse([dataclasses.replace(records[AZ], detector_v=detector_v)], "right")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04torn", b"no bench"])
def test_a_file_that_is_no_bench_record_is_refused(rig, tmp_path, content):
    path = tmp_path / "bench.npz"
    path.write_bytes(content)
    with pytest.raises(IdentifyError, match="not a bench record"):
        response.read_bench(path, rig.loops["right"].fsm)


SAMPLE_COLUMNS = ("time_s", "drive_v", "detector_az_v", "detector_el_v")


def npz(path, **zip_options):
    """A bench record as numpy writes it, or as a ZIP of another make."""
    with zipfile.ZipFile(path, "w", **zip_options) as archive:
        for name in SAMPLE_COLUMNS:
            column = io.BytesIO()
            np.save(column, np.arange(1000.0))
            archive.writestr(f"{name}.npy", column.getvalue())


def with_a_flipped_byte(path):
    npz(path, compression=zipfile.ZIP_DEFLATED)
    content = bytearray(path.read_bytes())
    content[60] ^= 0xFF
    path.write_bytes(content)


def encrypted(path):
    npz(path)
    content = path.read_bytes().replace(
        b"PK\x01\x02\x14\x03\x14\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01"
    )
    path.write_bytes(content)


def of_another_method(path):
    npz(path, compression=zipfile.ZIP_BZIP2)


def of_one_array(path):
    with path.open("wb") as file:
        np.save(file, np.arange(1000.0))


@pytest.mark.parametrize(
    ("write", "why"),
    [
        (with_a_flipped_byte, "error:? "),
        (encrypted, "is encrypted"),
        (of_another_method, "is packed as"),
        (of_one_array, "not a zip file"),
    ],
)
def test_a_damaged_or_odd_archive_is_refused_in_one_line(rig, tmp_path, write, why):
    path = tmp_path / "bench.npz"
    write(path)
    with pytest.raises(IdentifyError, match=rf"not a bench record \(.*{why}") as raised:
        response.read_bench(path, rig.loops["right"].fsm)
    assert "\n" not in str(raised.value)


def forged(path, shape, dtype="<f8"):
    """A record whose columns promise more than they have."""
    with zipfile.ZipFile(path, "w") as archive:
        for name in SAMPLE_COLUMNS:
            column = io.BytesIO()
            header = {"descr": dtype, "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(column, header)
            archive.writestr(f"{name}.npy", column.getvalue() + bytes(8000))


@pytest.mark.parametrize(
    ("shape", "dtype"), [((10**15,), "<f8"), ((10**9,), "<f8"), ((10**12,), "|S0"), ((-1,), "<f8")]
)
def test_a_header_that_promises_more_than_there_is_needs_no_memory(rig, tmp_path, shape, dtype):
    path = tmp_path / "bench.npz"
    forged(path, shape, dtype)
    with pytest.raises(IdentifyError, match="not a bench record"):
        response.read_bench(path, rig.loops["right"].fsm)


def test_a_small_file_that_unpacks_to_gigabytes_is_refused(rig, tmp_path):
    path = tmp_path / "bench.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("time_s.npy", bytes(300 << 20))
    with pytest.raises(IdentifyError, match="314572800 bytes once unpacked; expected at most"):
        response.read_bench(path, rig.loops["right"].fsm)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("", "its first line does not name time_s, drive_v, detector_az_v, detector_el_v"),
        ("time_s,drive_v,detector_az_v\n", "its first line does not name detector_el_v"),
        ("time_s,drive_v,detector_az_v,detector_el_v\n", "time_s does not rise evenly"),
    ],
)
def test_a_table_without_a_column_or_samples_is_refused_without_a_warning(
    rig, tmp_path, content, why, recwarn
):
    path = tmp_path / "bench.csv"
    path.write_text(content)
    with pytest.raises(IdentifyError, match=why):
        response.read_bench(path, rig.loops["right"].fsm)
    assert not recwarn.list


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_pipe_is_no_bench_record_and_nobody_waits_for_it(rig, tmp_path, suffix):
    pipe = tmp_path / f"bench{suffix}"
    os.mkfifo(pipe)
    with pytest.raises(IdentifyError, match="not a regular file"):
        response.read_bench(pipe, rig.loops["right"].fsm)
