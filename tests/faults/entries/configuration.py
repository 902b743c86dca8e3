"""Configuration wrong in more than thirty ways: what is wrong, and the word that the one line must have."""

from typing import NamedTuple


class Wrong(NamedTuple):
    """A rig that must be refused.

    Attributes
    ----------
    what : str
    says : str
        In the one line that is printed.
    sets : tuple of str
        Values to replace, as ``--set`` has them.
    change : tuple of str
        A text of the shipped rig file, and what stands in its stead.
    """

    what: str
    says: str
    sets: tuple[str, ...] = ()
    change: tuple[str, str] = ("", "")


WRONG = (
    Wrong("a key that does not exist", "did you mean frame_rate_hz?", ("camera.frame_rate=50",)),
    Wrong("a section that does not exist", "unknown key", ("kamera.width_px=40",)),
    Wrong("a value without a key", "expected key.path=value", ("=50",)),
    Wrong("a key without a value", "expected key.path=value", ("camera.width_px",)),
    Wrong("a word for a number", "must be a valid number", ("camera.frame_rate_hz=fast",)),
    Wrong("a number that is none", "camera.frame_rate_hz", ("camera.frame_rate_hz=nan",)),
    Wrong("an infinite number", "camera.bias_dn", ("camera.bias_dn=inf",)),
    Wrong("a negative rate", "greater than or equal to 1", ("camera.frame_rate_hz=-3",)),
    Wrong("no light", "star_flux_dn", ("loops.right.star_flux_dn=0.0",)),
    Wrong("half a frame", "must be a valid integer", ("loops.right.acquisition.found_frames=2.5",)),
    Wrong("an unknown driver", "must be 'gige' or 'aravis'", ("camera.device.driver=usb",)),
    Wrong("an unknown amplifier", "driver", ("loops.right.siderostat.device.driver=stepper",)),
    Wrong("a port that cannot be", "65535", ("camera.device.gvcp_port=70000",)),
    Wrong("a CAN node that cannot be", "127", ("loops.right.siderostat.device.node_id=128",)),
    Wrong("an exposure longer than a frame", "exposure_s", ("camera.exposure_s=0.03",)),
    Wrong("a delay that no frame can keep", "stale_s must be above", ("camera.frame_delay_s=0.3",)),
    Wrong("a target outside the picture", "target_px", ("loops.right.target_px.az=40.0",)),
    Wrong("a window larger than the camera", "width_px", ("camera.width_px=8",)),
    Wrong("more range than the D/A has volts", "range_rad", ("loops.right.fsm.range_rad=1.9e-4",)),
    Wrong("a servo that would swing", "gain_per_s", ("loops.right.siderostat.servo.rate_hz=50.0",)),
    Wrong("a flux range upside down", "low", ("loops.right.flux_range.low=2.0",)),
    Wrong("an interlock without a limit", "odd", (
        "interlocks.odd={ quantity = 'disk_free_bytes', for_s = 0.0, modes = ['OFF'],"
        " action = 'warn', reset = 'hand' }",)),
    Wrong("an interlock on nothing known", "quantity", ("interlocks.disk_space.quantity=moon",)),
    Wrong("an interlock in a mode that is none", "modes", ("interlocks.disk_space.modes=['ON']",)),
    Wrong("an interlock with an unknown action", "action", ("interlocks.disk_space.action=fire",)),
    Wrong("an unknown compression", "'zstd', 'lz4' or 'none'", ("logging.compression=rar",)),
    Wrong("a queue for no records", "queue_records", ("logging.queue_records=0",)),
    Wrong("telemetry never sent", "telemetry_hz", ("supervisor.telemetry_hz=0.0",)),
    Wrong("an unknown controller", "controller", ("loops.right.vernier.controller=pid",)),
    Wrong("a fault without a kind", "mocks.faults.0.kind: is missing", (
        "mocks.faults=[{ device = 'camera' }]",)),
    Wrong("a plant of another loop", "must name the same loops", change=(
        "plant.loops.right", "plant.loops.left")),
    Wrong("a file of another version", "schema_version: must be 2", change=(
        "schema_version = 2", "schema_version = 1")),
    Wrong("a value that was forgotten", "time_constant_s: is missing", change=(
        "time_constant_s = 1.0", "")),
    Wrong("a bracket too few", "not TOML", change=("[camera]", "[camera")),
    Wrong("the same key twice", "not TOML", change=(
        "schema_version = 2", "schema_version = 2\nschema_version = 2")),
    Wrong("an include that is not there", "gone.toml", change=(
        "schema_version = 2", 'include = ["gone.toml"]\nschema_version = 2')),
    Wrong("a base that is not there", "gone.toml", change=(
        "schema_version = 2", 'base = "gone.toml"\nschema_version = 2')),
    Wrong("a socket folder too long for a socket", "service.folder", (
        "service.folder=/tmp/" + "x" * 120,)),
    Wrong("a log folder where nothing can be", "logging.folder", ("logging.folder=/dev/null/x",)),
)  # fmt: skip
