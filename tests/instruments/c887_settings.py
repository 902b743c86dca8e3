"""The testbed's hexapod and its mock as tests have them: quick, and referenced unless a test says otherwise."""

from fitctl.config import C887Device, C887Mock, default_rig_path, load_rig

_RIG = load_rig(default_rig_path().parent / "fit-testbed.toml")
MOCK: C887Mock = _RIG.mocks.hexapod.model_copy(
    update={
        "tcp_port": 0,
        "acceleration_mm_s2": 100.0,
        "acceleration_deg_s2": 75.0,
        "referenced": True,
        "reference_s": 0.3,
        "reply_s": 0.001,
    }
)


def device(port: str, **update: object) -> C887Device:
    """The rig's hexapod at another port."""
    return _RIG.collector.hexapod.model_copy(update={"port": port} | update)
