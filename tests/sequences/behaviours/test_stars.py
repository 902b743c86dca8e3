"""Lists of stars: each is acquired where it is expected, held and judged; one that is missing is skipped."""

from concurrent.futures import Future

import numpy as np
import pytest

from fitctl import Instrument
from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.model.optics import scales
from fitctl.sequences.behaviours.stars import star_results, steps_of
from fitctl.sequences.reading import load_sequence, read_stars
from fitctl.sequences.steps import Star, Stars
from fitctl.sequences.view import SequenceError
from fitctl.supervisor.device_jobs import Job

SKY = load_rig(default_rig_path().parent / "star-field.toml", ["supervisor.telemetry_hz=10.0"])
QUICK = {"duration_s": 2.0, "settle_s": 3.0, "search_radius_sky_arcsec": 60.0}
ALPHA = {"name": "alpha", "az_sky_arcsec": 0.0, "el_sky_arcsec": 0.0}
BETA = {"name": "beta", "az_sky_arcsec": 600.0, "el_sky_arcsec": 150.0}
GAMMA = {"name": "gamma", "az_sky_arcsec": -450.0, "el_sky_arcsec": 500.0}  # half as bright
MISSING = {"name": "nobody", "az_sky_arcsec": -700.0, "el_sky_arcsec": -600.0}


def true_sky_arcsec(instrument):
    """Where the field's stars truly are, from where the encoders read zero."""
    plant = instrument._link._simulation.plants["right"]
    loop = SKY.loops["right"]
    origin_px = plant.constants.spot_origin_px[0] - (loop.target_px.az, loop.target_px.el)
    names = [spot.name for spot in SKY.plant.loops["right"].spots]
    return dict(zip(names, origin_px * scales(SKY, loop).sky_arcsec_per_px, strict=True))


@pytest.mark.long
def test_each_star_is_found_where_it_is_and_a_missing_one_is_skipped():
    with Instrument(SKY, simulate=True, seed=3) as instrument:
        figures = instrument.stars([ALPHA, MISSING, BETA], **QUICK)
        results = {result.name: result for result in star_results(instrument.attempts)}
        truth = true_sky_arcsec(instrument)

    assert figures == {"stars": 3.0, "held": 2.0}
    for name in ("alpha", "beta"):
        found = [results[name].figures[f"found_{axis}_sky_arcsec"] for axis in ("az", "el")]
        assert found == pytest.approx(truth[name], abs=1.5)  # half the play is 0.5
        assert results[name].figures["rms_az_px"] < 0.1
        assert results[name].why_not == ""
    assert "no star within 60 arcsec" in results["nobody"].why_not
    assert np.linalg.norm(truth["alpha"]) > 3.0  # the list's error is real


@pytest.mark.long
def test_a_star_is_taken_for_the_one_that_is_meant_by_its_own_flux():
    faint, bright = {"star_flux_dn": 14000.0}, {"star_flux_dn": 28000.0}
    stars = [
        GAMMA | faint,
        BETA,  # as bright as the rig file says: what gamma needed is not kept for it
        GAMMA | bright | {"name": "not so bright"},
        BETA | faint | {"name": "not so faint"},
    ]
    with Instrument(SKY, simulate=True, seed=3) as instrument:
        instrument.stars(stars, **QUICK)
        results = {result.name: result for result in star_results(instrument.attempts)}

    assert {name for name, result in results.items() if not result.why_not} == {"gamma", "beta"}
    assert results["gamma"].figures["found_flux_dn"] == pytest.approx(14000.0, rel=0.1)
    assert results["beta"].figures["found_flux_dn"] == pytest.approx(28000.0, rel=0.1)
    for name in ("not so bright", "not so faint"):
        assert "no star within 60 arcsec" in results[name].why_not


MOVING_SKY = load_rig(
    default_rig_path().parent / "star-field.toml",
    [
        "supervisor.telemetry_hz=10.0",
        "plant.loops.right.star_rate_sky_arcsec_s={az=12.0, el=-9.0}",
        "loops.right.siderostat.travel_sky_arcsec=3000.0",
        "loops.right.siderostat.device.position_limit_rad=0.0",
    ],
)


@pytest.mark.long
def test_each_star_is_followed_at_its_own_rate_from_where_it_was_as_the_list_began():
    rate = {"rate_az_sky_arcsec_s": 12.0, "rate_el_sky_arcsec_s": -9.0}
    with Instrument(MOVING_SKY, simulate=True, seed=3) as instrument:
        instrument.standby()
        instrument.stars(
            [ALPHA | rate, MISSING | rate, BETA | rate, ALPHA | {"name": "at rest"}], **QUICK
        )
        results = {result.name: result for result in star_results(instrument.attempts)}
        passed_s = instrument._link._simulation.clock.now_s()

    assert (
        15.0 * passed_s > 3 * QUICK["search_radius_sky_arcsec"]
    )  # it is nowhere near its first place
    for name in ("alpha", "beta"):
        assert results[name].why_not == ""
        assert max(results[name].figures[f"rms_{axis}_px"] for axis in ("az", "el")) < 0.05
    assert results["nobody"].why_not
    assert results["at rest"].why_not


def test_each_attempt_searches_where_the_star_has_moved_to():
    star = Star(**BETA, rate_az_sky_arcsec_s=12.0, rate_el_sky_arcsec_s=-9.0)

    acquire, _ = steps_of(Stars(stars=[star]), star, 10.0)

    place = acquire.expected_az_sky_arcsec, acquire.expected_el_sky_arcsec
    assert place == pytest.approx((720.0, 60.0))
    assert (acquire.rate_az_sky_arcsec_s, acquire.rate_el_sky_arcsec_s) == (12.0, -9.0)


def test_a_list_may_end_with_its_first_failure():
    with Instrument(SKY, simulate=True) as instrument:
        with pytest.raises(
            SequenceError, match=r"\(acquire, star nobody\) failed: .*no star within"
        ):
            instrument.stars([MISSING, ALPHA], on_failure="fail", **QUICK)

        assert [attempt.star for attempt in instrument.attempts] == ["", "nobody"]


def test_too_few_held_stars_fail_the_step():
    with Instrument(SKY, simulate=True) as instrument:
        with pytest.raises(
            SequenceError, match="0 of 1 stars held; skipped nobody; least_held is 1"
        ):
            instrument.stars([MISSING], **QUICK)

        outcomes = [(attempt.step, attempt.outcome) for attempt in instrument.attempts]
    assert outcomes == [("standby", "done"), ("acquire", "failed"), ("stars", "failed")]


def test_devices_that_are_not_ready_end_the_list_and_no_star_is_skipped(tried):
    run = tried()
    run.link._simulation.supervisor._device_jobs._job = Job(Future(), lambda _: None)  # never ends

    run({"step": "stars", "stars": [ALPHA, BETA], **QUICK})

    assert [attempt.step for attempt in run.attempts] == ["standby", "standby"]
    assert "devices are being opened or closed" in run.error


FILES = {
    "a.csv": "# a comment\nname, az_sky_arcsec, el_sky_arcsec, duration_s, star_flux_dn\n\n"
    "alpha,0,-1.5,,5e3\n7, 2e2,3,9,\n",
    "a.toml": "stars = [{name='alpha', az_sky_arcsec=0, el_sky_arcsec=-1.5, star_flux_dn=5000},"
    "{name='7', az_sky_arcsec=200.0, el_sky_arcsec=3, duration_s=9}]",
    "a.yaml": "stars:\n- {name: alpha, az_sky_arcsec: 0, el_sky_arcsec: -1.5, star_flux_dn: 5e3}\n"
    "- {name: '7', az_sky_arcsec: 200, el_sky_arcsec: 3, duration_s: 9}\n",
}


@pytest.mark.parametrize("name", FILES)
def test_a_list_is_csv_toml_or_yaml(tmp_path, name):
    path = tmp_path / name
    path.write_text(FILES[name])

    assert read_stars(path) == [
        Star(name="alpha", az_sky_arcsec=0.0, el_sky_arcsec=-1.5, star_flux_dn=5000.0),
        Star(name="7", az_sky_arcsec=200.0, el_sky_arcsec=3.0, duration_s=9.0),
    ]


def test_a_byte_order_mark_is_no_part_of_the_first_column(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(FILES["a.csv"].partition("\n")[2], encoding="utf-8-sig")

    assert [star.name for star in read_stars(path)] == ["alpha", "7"]


def test_a_star_that_is_called_by_a_number_keeps_each_digit(tmp_path):
    path = tmp_path / "a.csv"
    names = ["007", "1234567", "1234568", "5853498713190525696"]
    path.write_text("\n".join(["name,az_sky_arcsec,el_sky_arcsec", *(f"{n},0,0" for n in names)]))

    assert [star.name for star in read_stars(path)] == names


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,az_sky_arcsec,el_sky_arcsec\n\na,1,b\n", "line 3: el_sky_arcsec: must be a valid"),
        ("name,az_sky_arcsec,el_sky_arcsec\na,1,\n", "line 2: el_sky_arcsec: is missing"),
        ("name,az_sky_arcsec,el_sky_arcsec\na,1\n", "line 2: 2 values for 3 columns"),
        ("name,az_sky_arcsec,el_sky_arcsec\na,inf,0\n", "az_sky_arcsec: must be a finite number"),
        (
            "name,az,el_sky_arcsec\na,1,2\n",
            "line 2: az: unknown key (allowed here: name, az_sky_arcsec",
        ),
        ('name,az_sky_arcsec,el_sky_arcsec\n"a,1,2\n', "not CSV"),
        ("# nothing\n", "is empty; its first line must name the columns"),
        (
            "name,az_sky_arcsec,el_sky_arcsec,az_sky_arcsec\na,0,0,500\n",
            "column az_sky_arcsec is there twice",
        ),
    ],
)
def test_a_mistake_in_a_list_is_told_with_its_line(tmp_path, text, said):
    path = tmp_path / "a.csv"
    path.write_text(text)

    with pytest.raises(ConfigError) as caught:
        read_stars(path)

    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)


HEAD = 'schema_version = 1\nname = "a"\ndescription = "b"\n[[steps]]\nstep = "stars"\n'


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ("", "there are no stars; give stars, or a file of them"),
        ('file = "none.csv"', "none.csv: no such list of stars"),
        ("stars = []", "stars: "),
        ('stars = [A]\nfile = "b.csv"', "step 1 (stars): has both stars and file (b.csv)"),
        ("least_held = 2\nstars = [A]", "least_held is 2; there are 1 stars"),
        ("stars = [A, A]", "star alpha: is twice in the list"),
        ("stars = [{name='far', az_sky_arcsec=1100, el_sky_arcsec=0}]", "star far: the search would"),
        ("stars = [A]\non_failure = 'go'", "on_failure: must be"),
        ("stars = [{name='f', az_sky_arcsec=0, el_sky_arcsec=0, star_flux_dn=20}]",
         "star f: a star of 20 DN could not be distinguished from noise"),
        ("stars = [{name='f', az_sky_arcsec=0, el_sky_arcsec=0, star_flux_dn=-1}]",
         "step 1 (stars): star 1: star_flux_dn: must be greater than 0"),
        ("stars = [A, {name='b', az_sky_arcsec=1}]", "step 1 (stars): star 2: el_sky_arcsec: is missing"),
        ("stars = [{name='b', az_sky_arcsec=1, el_sky_arcsec=1, duratoin_s=1}]",
         "star 1: duratoin_s: unknown key; did you mean duration_s? (allowed here: name, az_sky_arcsec,"),
    ],
)  # fmt: skip
def test_a_list_that_cannot_be_gone_through_is_refused_before_anything_moves(tmp_path, keys, said):
    path = tmp_path / "a.toml"
    alpha = '{name = "alpha", az_sky_arcsec = 0.0, el_sky_arcsec = 0.0}'
    path.write_text(HEAD + keys.replace("A", alpha))

    with pytest.raises(ConfigError) as caught:
        load_sequence(path, SKY)

    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
