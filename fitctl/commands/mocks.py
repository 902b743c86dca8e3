"""`fitctl mocks`: the rig's mock devices, until a signal comes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import typer
import zmq
from numpy.typing import NDArray

from fitctl.commands.printing import to_json
from fitctl.config import ConfigError, LoopMocks, Rig
from fitctl.logging.errors import LogError
from fitctl.logging.pictures import LoggedPictures
from fitctl.mocks.event_loop import run_on_time
from fitctl.mocks.faults import UnknownFault
from fitctl.mocks.testbed import Testbed
from fitctl.processes import ENDING_SIGNALS, end_with_parent
from fitctl.stages.realtime import become_realtime

Picture = Callable[[float], NDArray[np.uint16]]

_PRIORITY = 40  # below all threads of the supervisor


def run_mocks(
    rig: Rig,
    seed: int,
    camera_log: Path | None,
    *,
    as_json: bool,
    free_ports: bool,
    parent_pid: int | None,
) -> None:
    """Serve the mock testbed until a signal comes; its camera shows a log's frames, if there is one."""
    picture = None if camera_log is None else _pictures(rig, camera_log)
    if free_ports:
        rig = _with_free_ports(rig)
    end_with_parent(parent_pid)
    run_on_time(_serve_mocks(rig, seed, picture, as_json=as_json, free_ports=free_ports))


def _pictures(rig: Rig, log: Path) -> Picture:
    camera = rig.true_camera
    try:
        return LoggedPictures(
            log,
            camera.width_px,
            camera.height_px,
            camera.period_s,
            camera.bias_dn,
            lambda why: typer.echo(f"mocks: {why}; it is dark from here on", err=True),
        )
    except LogError as error:
        raise ConfigError(str(error)) from None


def _with_free_ports(rig: Rig) -> Rig:
    _, mocks = rig.mock_parts()
    loops = {name: _loop_with_free_ports(loop) for name, loop in mocks.loops.items()}
    free = mocks.model_copy(update={"gvcp_port": 0, "loops": loops})
    return rig.model_copy(update={"mocks": free})


def _loop_with_free_ports(loop: LoopMocks) -> LoopMocks:
    update: dict[str, Any] = {"slcan_port": 0, "modbus_port": 0, "mdt693_port": 0}
    if loop.ensemble is not None:
        update["ensemble"] = loop.ensemble.model_copy(update={"tcp_port": 0})
    if loop.bal_analog is not None:
        update["bal_analog"] = loop.bal_analog.model_copy(update={"modbus_port": 0})
    return loop.model_copy(update=update)


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
        msg = f"mocks: a port is taken: {error}; choose others with --set, or use --free-ports"
        raise ConfigError(msg) from None
    if as_json:
        print(to_json(endpoints), flush=True)
    else:
        width = max(map(len, endpoints))
        for key, value in endpoints.items():
            print(f"{key:<{width}}  {value}", flush=True)
    # The hardware that they stand for does not wait for what else the computer has to do.
    become_realtime(_PRIORITY)
    await ending.wait()
    await testbed.stop()
