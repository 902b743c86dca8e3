import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples.log_samples import filled

from fitctl.config import AxisPair, Spot
from fitctl.identify.errors import IdentifyError
from fitctl.identify.frames import (
    TimedImage,
    find_spots,
    frames_of_log,
    frames_of_records,
    longest_rest,
    track_spots,
)
from fitctl.identify.record import tick_columns
from fitctl.logging.errors import LogError
from fitctl.logging.records import FrameRecord, RunInfo, Tick
from fitctl.logging.writer import LogWriter
from fitctl.messages.modes import Mode
from fitctl.model.image.scene import Scene

NOWHERE = AxisPair(az=0.0, el=0.0)
RUN_INFO = RunInfo(
    time_s=100.0,
    wall_minus_monotonic_s=1_795_000_000.25,
    rig_name="bench",
    rig_json="{}",
    versions={},
    scheduling="none",
)
_VALUES = {float: 0.125, int: 3, bool: True, str: "right"}


def tick(**values):
    """A tick of loop right with something in every field."""
    return Tick(**{f.name: _VALUES[f.type] for f in msgspec.structs.fields(Tick)} | values)


def spot(flux_dn):
    return Spot(name="x", offset_px=NOWHERE, flux_dn=flux_dn, diameter_px=3.0)


def frame_of(camera, spots, seed=0):
    """`spots` is a list of (az_px, el_px, flux_dn)."""
    scene = Scene(camera, [spot(flux_dn) for _, _, flux_dn in spots])
    return scene.frame(np.array([s[:2] for s in spots]), seed, 0)


@pytest.fixture
def loop(rig):
    return rig.loops["right"]


def test_all_spots_are_found_and_numbered_by_flux(rig, loop):
    image = frame_of(rig.camera, [(10.2, 30.4, 9000), (24.3, 19.1, 28000), (12.0, 8.0, 14000)])
    found = find_spots(image, rig.camera, loop)
    assert [round(star.flux_dn, -3) for star in found] == [28000, 14000, 9000]
    assert [(star.az_px, star.el_px) for star in found] == [
        pytest.approx(place, abs=0.1) for place in ((24.3, 19.1), (12.0, 8.0), (10.2, 30.4))
    ]


def test_a_hot_pixel_and_a_spot_cut_by_the_edge_are_no_spots(rig, loop):
    image = frame_of(rig.camera, [(24.0, 19.0, 28000), (10.0, 0.2, 20000)])
    image[30, 8] = 30000
    assert len(find_spots(image, rig.camera, loop)) == 1


@settings(max_examples=20)
@given(
    az_px=st.floats(8, 30),
    el_px=st.floats(8, 30),
    drift_px=st.floats(-0.03, 0.03),
    seed=st.integers(0, 99),
)
def test_a_spot_is_followed_as_it_wanders(rig, az_px, el_px, drift_px, seed):
    loop, camera = rig.loops["right"], rig.camera
    path_px = az_px + drift_px * np.arange(100)
    scene = Scene(camera, [spot(28000)])
    frames = [
        TimedImage(5 + 0.02 * k, scene.frame(np.array([[az, el_px]]), seed, k))
        for k, az in enumerate(path_px)
    ]
    tracks = track_spots(frames, camera, loop)
    assert tracks.px.shape == (100, 1, 2)
    assert tracks.px[:, 0, 0] == pytest.approx(path_px, abs=0.06)
    assert tracks.px[:, 0, 1] == pytest.approx(np.full(100, el_px), abs=0.06)


def test_a_lost_frame_is_filled_by_a_straight_line(rig, loop):
    frames = [
        TimedImage(0.02 * k, frame_of(rig.camera, [(20 + 0.01 * k, 19, 28000)], seed=k))
        for k in range(100)
        if k != 50
    ]
    tracks = track_spots(frames, rig.camera, loop)
    assert len(tracks.px) == 100
    assert tracks.filled == pytest.approx(0.01)
    assert tracks.px[50, 0] == pytest.approx(tracks.px[[49, 51], 0].mean(axis=0))


@pytest.mark.long
def test_too_many_frames_without_the_spot_are_refused(rig, loop):
    empty = np.full((40, 40), 1000, dtype=np.uint16)
    frames = [
        TimedImage(0.02 * k, empty if k % 20 == 10 else frame_of(rig.camera, [(20, 19, 28000)]))
        for k in range(100)
    ]
    with pytest.raises(IdentifyError, match=r"5\.\d% of the frames"):
        track_spots(frames, rig.camera, loop)


def test_frames_without_any_spot_are_refused(rig, loop):
    empty = np.full((40, 40), 1000, dtype=np.uint16)
    with pytest.raises(IdentifyError, match="no spot on any frame"):
        track_spots([TimedImage(0.0, empty)] * 3, rig.camera, loop)


# ---------------------------------------------------------------- which frames


def still_from(first, last, ticks=500):
    """Ticks of a run in which the mirror stood still from one tick to another."""
    time_s = 100 + 0.02 * np.arange(ticks)
    stack_v = np.linspace(0, 1, ticks)
    stack_v[first:last] = 5.0
    return [
        tick(
            time_s=time + 0.035,
            mid_exposure_s=time,
            number=k,
            stack1_v=float(stack_v[k]),
            link_az_rad=np.nan,
            link_el_rad=np.nan,
        )
        for k, time in enumerate(time_s.tolist())
    ]


def test_the_longest_rest_begins_after_the_stages_have_settled():
    ticks = still_from(100, 400)
    arrays = {name: np.array([getattr(t, name) for t in ticks]) for name in Tick.__struct_fields__}
    start_s, end_s = longest_rest(arrays)
    assert start_s == pytest.approx(100 + 2.0 + 0.235, abs=0.021)
    assert end_s == pytest.approx(100 + 7.98)


def test_ticks_of_0_1_0_without_a_link_have_a_rest_too():
    ticks = tick_columns(still_from(100, 400))
    whole = longest_rest(ticks)
    del ticks["link_az_rad"], ticks["link_el_rad"]
    assert longest_rest(ticks) == whole


def test_over_a_link_the_siderostat_may_move_in_open_loop():
    """From tick 100 to 300 the loop is open; before and after, the mirror stands still in a search."""
    modes = [Mode.EXPERIMENT if 100 <= k < 300 else Mode.ACQUISITION for k in range(500)]
    ticks = [
        tick(
            time_s=100 + 0.02 * k + 0.035,
            mid_exposure_s=100 + 0.02 * k,
            number=k,
            mode=mode.name,
            mode_number=mode,
            siderostat_setpoint_az_rad=0.01 * k,
            link_az_rad=0.02 * k,
            link_el_rad=0.0,
        )
        for k, mode in enumerate(modes)
    ]
    start_s, end_s = longest_rest(tick_columns(ticks))

    assert start_s == pytest.approx(100 + 2.0 + 0.235, abs=0.021)
    assert end_s == pytest.approx(100 + 5.98)
    with pytest.raises(IdentifyError, match="never stood still"):
        longest_rest(tick_columns(ticks[:100]))


def test_stages_that_always_move_give_no_rest(rig):
    with pytest.raises(IdentifyError, match="never stood still"):
        list(frames_of_records(still_from(0, 0), "right", rig.camera))


@pytest.mark.long
def test_frames_of_records_and_of_their_log_are_the_same(rig, tmp_path):
    records = []
    for made in still_from(100, 200, ticks=250):
        image = frame_of(rig.camera, [(20, 19, 28000)], seed=made.number)
        frame = FrameRecord(
            time_s=made.mid_exposure_s,
            camera="focal plane",
            number=made.number,
            width_px=40,
            height_px=40,
            data=image.tobytes(),
        )
        records += [made, frame]
    path = tmp_path / "run.mcap"
    with LogWriter(path, rig.logging) as log:
        log.write(RUN_INFO, 0.0)
        for record in records:
            log.write(record, 0.0)
    kept, read = (
        list(frames_of_records(records, "right", rig.camera)),
        list(frames_of_log(path, "right", rig.camera)),
    )
    assert 80 < len(kept) < 100
    assert [frame.time_s for frame in read] == pytest.approx(
        [frame.time_s for frame in kept], abs=1e-6
    )
    assert all(np.array_equal(a.image, b.image) for a, b in zip(kept, read, strict=True))


@pytest.mark.parametrize(("size", "height_px"), [(3200, 39), (3, 1), (0, 40), (0, 0), (6400, 40)])
def test_a_frame_of_another_size_than_the_cameras_is_refused(rig, size, height_px):
    frame = FrameRecord(
        time_s=103.0,
        camera="focal plane",
        number=0,
        width_px=40,
        height_px=height_px,
        data=bytes(size),
    )
    with pytest.raises(IdentifyError, match=f"{size} bytes in {height_px} rows; expected 40 x 40"):
        list(frames_of_records([*still_from(100, 200, ticks=250), frame], "right", rig.camera))


def test_a_log_without_frames_is_refused(rig, tmp_path):
    path = tmp_path / "run.mcap"
    with LogWriter(path, rig.logging) as log:
        log.write(RUN_INFO, 0.0)
        for made in still_from(100, 200, ticks=250):
            log.write(made, 0.0)
    with pytest.raises(IdentifyError, match="has no frames"):
        list(frames_of_log(path, "right", rig.camera))


def test_a_log_that_does_not_say_what_its_times_are_is_refused(rig, tmp_path):
    path = tmp_path / "run.mcap"
    with LogWriter(path, rig.logging) as log:
        for made in [*still_from(100, 200, ticks=250), filled(FrameRecord, width_px=40)]:
            log.write(made, 0.0)
    with pytest.raises(LogError, match=r"run\.mcap: has no start of its run"):
        list(frames_of_log(path, "right", rig.camera))


def test_frames_that_never_show_all_spots_are_refused(rig, loop):
    image = frame_of(rig.camera, [(20, 19, 28000)])
    with pytest.raises(IdentifyError, match="no two frames"):
        track_spots([TimedImage(0.0, image)], rig.camera, loop)
