"""`fitctl mocks`: the rig's mock devices, until a signal comes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import zmq
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from fitctl.commands.shared.options import (
    JsonOption,
    ParentOption,
    SeedOption,
    SetOption,
    ShippedRigOption,
)
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import rig_of
from fitctl.config import ConfigError, Fault, Rig, Settings
from fitctl.config.reading import read_toml
from fitctl.logging.pictures import LoggedPictures
from fitctl.mocks.event_loop import run_on_time
from fitctl.mocks.faults import UnknownFault
from fitctl.mocks.testbed import Testbed
from fitctl.processes import ENDING_SIGNALS, end_with_parent
from fitctl.stages.realtime import become_realtime

Picture = Callable[[float], NDArray[np.uint16]]

_PRIORITY = 40  # below all threads of the supervisor


def mocks(
    rig: ShippedRigOption = None,
    overrides: SetOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
    free_ports: Annotated[
        bool, typer.Option("--free-ports", help="Use any free port for every device.")
    ] = False,
    faults: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="What goes wrong and when: a TOML file of [[fault]] tables."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="What the camera shows: a log's frames, in place of the mock star."
        ),
    ] = None,
    parent_pid: ParentOption = None,
) -> None:
    """Serve the mock devices of a rig on 127.0.0.1 until Ctrl-C, and print their addresses."""
    settings = rig_of(rig, overrides)
    if faults is not None:
        settings = _with_script(settings, faults)
    picture = None if camera is None else _pictures(settings, camera)
    if free_ports:
        settings = _with_free_ports(settings)
    end_with_parent(parent_pid)
    run_on_time(_serve_mocks(settings, seed, picture, as_json=as_json, free_ports=free_ports))


def _with_script(rig: Rig, path: Path) -> Rig:
    """The rig with a script's ``[[fault]]`` tables among its own faults.

    Raises
    ------
    ConfigError
        If the script cannot be read, or something is wrong in it.
    """
    _, mocks = rig.mock_parts()
    document = read_toml(path, "no such file; see docs/devices.md for how to write one")
    if set(document) != {"fault"}:
        msg = f"{path}: expected [[fault]] tables and nothing else; see docs/devices.md"
        raise ConfigError(msg)
    try:
        script = TypeAdapter(list[Fault]).validate_python(document["fault"])
    except ValidationError as error:
        first = error.errors()[0]
        msg = f"{path}: fault {'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(msg) from None
    faults = mocks.model_copy(update={"faults": [*mocks.faults, *script]})
    return rig.model_copy(update={"mocks": faults})


def _pictures(rig: Rig, log: Path) -> Picture:
    camera = rig.true_camera
    return LoggedPictures(
        log,
        camera.width_px,
        camera.height_px,
        camera.period_s,
        camera.bias_dn,
        lambda why: say(f"mocks: {why}; its picture stays dark from here on", err=True),
    )


def _with_free_ports(rig: Rig) -> Rig:
    _, mocks = rig.mock_parts()
    devices: dict[str, Any] = {
        "gvcp_port": 0,
        "loops": {name: _with_ports_0(loop) for name, loop in mocks.loops.items()},
        "hexapod": mocks.hexapod and _with_ports_0(mocks.hexapod),
    }
    return rig.model_copy(update={"mocks": mocks.model_copy(update=devices)})


def _with_ports_0(settings: Settings) -> Settings:
    """A mock's settings, and those within them, with each port any free one."""
    update: dict[str, Any] = {}
    for key, value in settings:
        if isinstance(value, Settings):
            update[key] = _with_ports_0(value)
        elif key.endswith("_port"):
            update[key] = 0
    return settings.model_copy(update=update)


async def _serve_mocks(
    rig: Rig, seed: int, picture: Picture | None, *, as_json: bool, free_ports: bool
) -> None:
    ending = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in ENDING_SIGNALS:
        loop.add_signal_handler(number, ending.set)
    # The bench has its own port where it can: there `fitctl fault` finds the mocks of a demo.
    testbed = Testbed(rig, seed, bench_at_any_port=free_ports, picture=picture)
    try:
        endpoints = await testbed.start()
    except UnknownFault as error:
        await testbed.stop()
        msg = f"mocks: {error}"
        raise ConfigError(msg) from None
    except (OSError, zmq.ZMQError) as error:
        await testbed.stop()
        msg = f"mocks: a port is in use: {error}; choose others with --set, or use --free-ports"
        raise ConfigError(msg) from None
    if as_json:
        say(to_json(endpoints))
    else:
        width = max(map(len, endpoints))
        for key, value in endpoints.items():
            say(f"{key:<{width}}  {value}")
    # The hardware that they stand for does not wait for what else the computer has to do.
    become_realtime(_PRIORITY)
    await ending.wait()
    await testbed.stop()
