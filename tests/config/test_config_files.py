"""Rig files as files: what is laid over what, and by which name a mistake is told."""

import json
from pathlib import Path

import pytest

from fitctl.config import ConfigError, default_rig_path, load_rig, reading, rig_from_log
from fitctl.config.commented import dump_commented, parse_commented
from fitctl.config.devices import DEVICE_TABLES
from fitctl.config.reading import _is_tag

# ---------------------------------------------------------------- files that are not rig files


def test_no_such_file(tmp_path):
    path = tmp_path / "gone.toml"
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    what_to_do = "name another with --rig, or write one with: fitctl init my-rig.toml"
    assert str(caught.value) == f"{path}: no such rig file; {what_to_do}"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[camera\n", r"not TOML: .*\(at line 1, column 8\)"),
        (b"name = 'a'\nname = 'b'\n", r"not TOML: .*line 2"),
        (b"\xff\xfe\x00", "cannot be read: 'utf-8' codec"),
        (b"x = " + b"[" * 3000, "not TOML: "),
        (b"schema_version = " + b"1" * 5000, "not TOML: .*digits"),
        (b"", "schema_version: is missing"),
    ],
)
def test_a_file_that_is_not_a_rig(tmp_path, content, said):
    path = tmp_path / "odd.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"odd\.toml: {said}"):
        load_rig(path)


def test_a_path_with_a_nul_and_a_number_without_end_are_refused(tmp_path):
    path = tmp_path / "odd.toml"
    path.write_text('base = "a\\u0000b"\n')
    with pytest.raises(ConfigError, match="cannot be read: embedded null byte"):
        load_rig(path)
    with pytest.raises(ConfigError, match=r"camera\.width_px"):
        load_rig(default_rig_path(), [f"camera.width_px={'1' * 5000}"])


def test_a_text_with_other_ends_of_lines_stays_one_line():
    text = 'description = "a\u2028b\u0085c"\n'

    assert dump_commented(parse_commented(text)) == text


@pytest.mark.parametrize("path", ["/", "/dev/null"])
def test_a_folder_or_a_device_is_not_a_rig(path):
    with pytest.raises(ConfigError, match=rf"{path}: cannot be read: not a regular file; give a"):
        load_rig(Path(path))


def test_a_file_much_larger_than_a_rig_is_not_read(tmp_path):
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.truncate((10 << 20) + 1)
    with pytest.raises(ConfigError, match=r"huge\.toml: cannot be read: more than 10 MiB; give a"):
        load_rig(path)


# ---------------------------------------------------------------- --set


def test_overrides_replace_values_in_order():
    rig = load_rig(
        default_rig_path(),
        [
            "camera.frame_rate_hz=25",
            "camera.frame_rate_hz = 40.0",
            "logging.compression=lz4",
            "loops.right.fsm.dac.host='10.0.0.9'",
            "loops.right.target_px={ az = 20.0, el = 20.0 }",
            "mocks.gvcp_port=0",
        ],
    )
    assert rig.camera.frame_rate_hz == 40.0
    assert rig.logging.compression == "lz4"
    assert rig.loops["right"].fsm.dac.host == "10.0.0.9"
    assert rig.loops["right"].target_px.az == 20.0
    assert rig.mocks.gvcp_port == 0


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("camera.frame_rate_hz", r"--set camera\.frame_rate_hz: expected key\.path=value"),
        ("=50", "expected key.path=value"),
        ("camera..x=1", "expected key.path=value"),
        ("camera.width_px.more=1", r"camera\.width_px is not a table"),
        ("loops.wrong.star_flux_dn=1", "there is no loop wrong; expected one of right"),
        ("plant.loops.right.spots.0.flux_dn=1.0", r"plant\.loops\.right\.spots is not a table"),
        ("camera.frame_rate=50", r"camera\.frame_rate: unknown key; did you mean frame_rate_hz\?"),
        ("loops.right.siderostat=[]", r"loops\.right\.siderostat: must be a table \(is \[\]\)$"),
        ("plant.loops=3", r"plant\.loops: must be a table \(is 3\)$"),
        ("plant.timeline=3", r"plant\.timeline: must be a list \(is 3\)$"),
        ("camera.frame_rate_hz=fast", r"camera\.frame_rate_hz: must be a valid number \(is 'fast'"),
        ("camera.frame_rate_hz=0", r"camera\.frame_rate_hz: must be greater than or equal to 1"),
    ],
)
def test_an_override_that_cannot_be_is_refused(override, said):
    with pytest.raises(ConfigError, match=said) as caught:
        load_rig(default_rig_path(), [override])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[loops.right.fsm]\nbias_x = 1.0", "loops.right.fsm.bias_x: unknown key"),
        ("[loops.right.siderostat]\nbacklash_sky_arcsec = -1.0", "(is -1.0)"),
        ("[loops.right.fsm.hysteresis]\nhalf_widths_v = [0.0, 1.0]", "half_widths_v 2"),
        ("[loops.right.fsm]\nrange_rad = 1.0", "range_rad: must be at most"),
        ('include = ["other.toml"]', "include: unknown key"),
        ("mocks = 3", "mocks: must be"),
        ("a = [", "not TOML"),
    ],
)
def test_what_a_fragment_has_wrong_is_told_with_its_name(tmp_path, text, said):
    (tmp_path / "good.toml").write_text("[camera]\nframe_delay_s = 0.03\n")
    (tmp_path / "bad.toml").write_text(text)
    rig_file = tmp_path / "rig.toml"
    include = 'include = ["bad.toml", "good.toml"]\n'
    rig_file.write_text(include + default_rig_path().read_text(encoding="utf-8"))
    with pytest.raises(ConfigError) as caught:
        load_rig(rig_file)
    for line in str(caught.value).splitlines():
        assert line.startswith(f"{tmp_path / 'bad.toml'}: ")
    assert said in str(caught.value)


def test_what_a_rig_file_has_wrong_beside_a_fragment_keeps_its_own_name(tmp_path):
    (tmp_path / "good.toml").write_text("[camera]\nframe_delay_s = 0.03\n")
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text(
        'include = ["good.toml"]\nunknown = 1\n' + default_rig_path().read_text(encoding="utf-8")
    )
    with pytest.raises(ConfigError) as caught:
        load_rig(rig_file)
    assert str(caught.value).startswith(f"{rig_file}: unknown: unknown key")


# ---------------------------------------------------------------- rigs that differ in a few tables


def based(tmp_path, text, base="base.toml"):
    (tmp_path / "base.toml").write_text(default_rig_path().read_text(encoding="utf-8"))
    path = tmp_path / "mine.toml"
    path.write_text(f'base = "{base}"\nname = "mine"\n{text}')
    return path


def test_a_rig_is_laid_over_its_base(tmp_path, rig):
    mine = load_rig(based(tmp_path, "[camera]\nframe_rate_hz = 40.0\n"), ["camera.width_px=50"])
    assert (mine.name, mine.camera.frame_rate_hz, mine.camera.width_px) == ("mine", 40.0, 50)
    assert mine.loops == rig.loops


def test_another_driver_leaves_nothing_of_the_device_in_the_base(tmp_path):
    device = "[loops.right.siderostat.device]\ndriver = 'ensemble'\nport = 'socket://x:8000'\n"
    with pytest.raises(ConfigError) as caught:
        load_rig(based(tmp_path, device))
    missing = {line.split(": ")[1].rpartition(".")[2] for line in str(caught.value).splitlines()}
    assert missing == {"baud_rate", "axes", "response_timeout_s", "software_limits_verified"}


def test_a_base_that_is_not_there_is_named(tmp_path):
    said = r"gone\.toml: no such rig file; it is the base of .*mine\.toml"
    with pytest.raises(ConfigError, match=said):
        load_rig(based(tmp_path, "", "gone.toml"))


def test_a_base_may_have_a_base_itself(tmp_path):
    under = based(tmp_path, "[camera]\nframe_rate_hz = 40.0\nwidth_px = 48\n")
    upper = tmp_path / "upper.toml"
    upper.write_text(f'base = "{under.name}"\nname = "upper"\n[camera]\nwidth_px = 50\n')
    rig = load_rig(upper)
    assert (rig.name, rig.camera.frame_rate_hz, rig.camera.width_px) == ("upper", 40.0, 50)


def test_the_include_list_is_that_of_the_uppermost_file_that_has_one(tmp_path):
    (tmp_path / "bias.toml").write_text("[camera]\nbias_dn = 990.0\n")
    under = based(tmp_path, "")
    under.write_text('include = ["bias.toml"]\n' + under.read_text())
    upper = tmp_path / "upper.toml"
    upper.write_text(f'base = "{under.name}"\nname = "upper"\n')
    assert load_rig(upper).camera.bias_dn == 990.0
    upper.write_text("include = []\n" + upper.read_text())
    assert load_rig(upper).camera.bias_dn == 1000.0


def test_a_file_that_is_its_own_base_is_named(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('base = "mine.toml"\n')
    with pytest.raises(
        ConfigError, match=r"mine\.toml: base: .* see whether a file is its own base"
    ):
        load_rig(path)


def test_a_base_must_be_a_name(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("base = 3\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: base: must be a file name \(is 3\)"):
        load_rig(path)


@pytest.mark.parametrize("table", sorted(DEVICE_TABLES))
def test_the_driver_of_a_device_is_no_part_of_its_keys(table):
    """pydantic puts it into the place of an error where a table may be of several devices."""
    assert _is_tag(["loops", "right", table], "ensemble")
    assert not _is_tag(["loops", "right", table], "port")
    assert not _is_tag(["loops"], "ensemble")


@pytest.mark.parametrize("table", ["loops.right", "camera", "loops.right.vernier"])
def test_what_lacks_in_a_table_that_set_gives_is_an_error_of_set(table):
    with pytest.raises(ConfigError) as raised:
        load_rig(default_rig_path(), [f"{table}={{}}"])

    lines = str(raised.value).splitlines()
    assert lines
    assert [line for line in lines if not line.startswith(f"--set: {table}.")] == []


def test_an_include_list_is_of_files_beside_the_file_that_has_it(tmp_path):
    below = tmp_path / "sub"
    below.mkdir()
    shipped = default_rig_path().read_text(encoding="utf-8")
    (below / "base.toml").write_text(f'include = ["frag.toml"]\n{shipped}')
    (below / "frag.toml").write_text("[camera]\nframe_delay_s = 0.031\n")
    (tmp_path / "frag.toml").write_text("[camera]\nframe_delay_s = 0.032\n")
    mine = tmp_path / "mine.toml"
    mine.write_text('base = "sub/base.toml"\n')

    assert load_rig(mine).camera.frame_delay_s == 0.031
    (below / "frag.toml").unlink()
    with pytest.raises(ConfigError) as caught:
        load_rig(mine)
    assert str(caught.value) == (
        f"{below / 'frag.toml'}: no such rig file; it is in the include list of {below / 'base.toml'}"
    )
    mine.write_text('base = "sub/base.toml"\ninclude = ["frag.toml"]\n')
    assert load_rig(mine).camera.frame_delay_s == 0.032


def test_a_file_that_begins_with_a_byte_order_mark_is_read(tmp_path, rig):
    path = tmp_path / "notepad.toml"
    path.write_bytes(b"\xef\xbb\xbf" + default_rig_path().read_bytes())

    assert load_rig(path) == rig


# ---------------------------------------------------------------- rigs that somebody made to harm


def test_of_many_mistakes_the_first_are_explained_and_the_others_counted(tmp_path):
    path = tmp_path / "many.toml"
    unknown = "".join(f"frame_rate_{number} = 1\n" for number in range(10_000))
    path.write_text(unknown + default_rig_path().read_text(encoding="utf-8"))

    with pytest.raises(ConfigError) as caught:
        load_rig(path)

    lines = str(caught.value).splitlines()
    assert len(lines) == 50
    assert lines[0].startswith(f"{path}: frame_rate_0: unknown key")
    assert lines[-1].endswith(" (9950 more)")


def test_of_the_rig_in_a_log_only_the_first_mistake_is_explained(rig, monkeypatch):
    document = json.loads(rig.model_dump_json())
    document |= {f"frame_rate_{number}": 1 for number in range(10_000)}
    explained = []
    monkeypatch.setattr(
        reading.difflib, "get_close_matches", lambda key, *_: explained.append(key) or []
    )

    with pytest.raises(ConfigError) as caught:
        rig_from_log(json.dumps(document), "a log")

    assert str(caught.value).startswith("a log: frame_rate_0: unknown key")
    assert " (9999 more); give a rig file" in str(caught.value)
    assert len(explained) < 100


def test_a_rig_in_a_log_that_is_far_too_long_is_not_read(rig):
    text = rig.model_dump_json() + " " * (1 << 20)

    with pytest.raises(
        ConfigError, match=r"a log: has [0-9]+ characters; expected at most 1048576"
    ):
        rig_from_log(text, "a log")


@pytest.mark.parametrize(
    "line",
    [
        "{0} = 1",
        "name = '{0}'",
        "camera = '{0}'",
        "base = ['{0}']",
        "include = ['{0}']",
        "include = '{0}'",
        "[{0}]\n[{0}]",
        "loops.right.siderostat.device.driver = '{0}'",
        "loops.{0}.kind = 'metrology'",
        "interlocks.{0}.action = 'none'",
        "[fringes]\nloops = ['{0}', '{0}']",
    ],
)
def test_a_key_or_value_without_end_is_shortened_in_messages(tmp_path, line):
    path = tmp_path / "odd.toml"
    path.write_text(line.format("x" * 100_000))

    with pytest.raises(ConfigError) as caught:
        load_rig(path)

    assert max(map(len, str(caught.value).splitlines())) < 5_000
    assert "xxx" in str(caught.value)


@pytest.mark.parametrize("override", ["{0}", "loops.{0}.kind=1", "name.{0}=1", "name={0}"])
def test_so_is_what_is_set(override):
    with pytest.raises(ConfigError) as caught:
        load_rig(default_rig_path(), [override.format("x" * 100_000)])
    assert len(str(caught.value)) < 1_000
