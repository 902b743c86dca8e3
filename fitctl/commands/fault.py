"""`fitctl fault`: what shall go wrong with running mock devices."""

from __future__ import annotations

import importlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from pydantic import TypeAdapter, ValidationError

from fitctl.config import ConfigError, Fault, Rig
from fitctl.mocks.bench import ClearFaults, FaultsNow, ListFaults, SetFault, ask_bench
from fitctl.mocks.faults import FaultKind

_MOCKS = {
    "camera": "fitctl.mocks.gige.camera",
    "drive": "fitctl.mocks.cia402.drive",
    "drive (ensemble)": "fitctl.mocks.ensemble.controller",
    "drive (bal_analog)": "fitctl.mocks.bal_analog.station",
    "dac": "fitctl.mocks.modbus_dac.server",
    "mdt693": "fitctl.mocks.mdt693.server",
}


def kinds() -> dict[str, Mapping[str, FaultKind]]:
    """What can go wrong with each kind of device."""
    return {name: importlib.import_module(module).FAULTS for name, module in _MOCKS.items()}


def with_script(rig: Rig, path: Path) -> Rig:
    """The rig with a script's ``[[fault]]`` tables among its own faults.

    Raises
    ------
    ConfigError
        If the script cannot be read, or something is wrong in it.
    """
    _, mocks = rig.mock_parts()
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        if set(document) != {"fault"}:
            msg = f"{path}: expected [[fault]] tables and nothing else; see docs/devices.md"
            raise ConfigError(msg)
        script = TypeAdapter(list[Fault]).validate_python(document["fault"])
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        msg = f"{path}: cannot be read as TOML: {error}"
        raise ConfigError(msg) from None
    except ValidationError as error:
        first = error.errors()[0]
        msg = f"{path}: fault {'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(msg) from None
    faults = mocks.model_copy(update={"faults": [*mocks.faults, *script]})
    return rig.model_copy(update={"mocks": faults})


def change_faults(rig: Rig, question: SetFault | ClearFaults | ListFaults) -> None:
    """Have it done, and print what is wrong then.

    Raises
    ------
    ConfigError
        If no mocks answer, or they have no such fault.
    """
    _, mocks = rig.mock_parts()
    if not mocks.bench_port:
        msg = "fault: mocks.bench_port is 0; give the port that the mocks printed: --set mocks.bench_port=PORT"
        raise ConfigError(msg)
    try:
        now = ask_bench(mocks.bench_port, question, FaultsNow)
    except ConnectionError as error:
        msg = f"fault: {error}; start fitctl mocks, or give its port: --set mocks.bench_port=PORT"
        raise ConfigError(msg) from None
    if now.error:
        msg = f"fault: {now.error}"
        raise ConfigError(msg)
    typer.echo(_told(now))


def list_kinds() -> None:
    """Print what can go wrong with each device."""
    for device, table in kinds().items():
        typer.echo(device)
        for name, kind in table.items():
            value = f" [{kind.value:g} {kind.unit}]" if kind.unit else ""
            parts = f" ({', '.join(kind.parts)})" if kind.parts else ""
            typer.echo(f"  {name:<18} {kind.text}{value}{parts}")


def _told(now: FaultsNow) -> str:
    return "\n".join(map(_line, now.active)) or "all is well"


def _line(fault: dict[str, Any]) -> str:
    words = [fault["device"], fault["kind"]]
    words += [str(fault[key]) for key in ("part", "value") if fault[key] not in {"", None}]
    if fault["for_s"] is not None:
        words.append(f"for {fault['for_s']:g} s")
    if fault["probability"] != 1:
        words.append(f"probability {fault['probability']:g}")
    return " ".join(words)
