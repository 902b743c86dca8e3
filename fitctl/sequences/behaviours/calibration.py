"""Calibrations on disk: fragments for the rig file, and the arrays that they name."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np

from fitctl.config import ConfigError, Rig
from fitctl.files import write_whole
from fitctl.identify.fragments import fragment_text
from fitctl.sequences.behaviours.behaviour import Calibration

# Steps that measure something for the rig file.
CALIBRATING = frozenset({"dark", "overlap", "plate_scale"})


def require_folder(folder: Path) -> None:
    """Refuse, before anything moves, a folder in which nothing could be written afterwards.

    Raises
    ------
    ConfigError
    """
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        msg = f"{folder}: is not a folder that can be written; name another for the calibrations with --out"
        raise ConfigError(msg)


def write_calibration(calibration: Calibration, rig: Rig, folder: Path) -> Path:
    """Write a calibration's arrays, then its fragment; the fragment's path.

    Raises
    ------
    ConfigError
        If that cannot be done.
    """
    path = folder / f"{rig.name}-{calibration.name}.toml"
    text = fragment_text(
        f"fitctl sequence, {calibration.name}", rig, calibration.lines, calibration.fragment
    )
    try:
        for name, array in calibration.arrays.items():
            npy = io.BytesIO()
            np.save(npy, array)
            write_whole(folder / name, npy.getvalue())
        write_whole(path, text.encode())
    except OSError as error:
        msg = f"{path}: cannot be written: {error}; make room or name another folder with --out, and run again"
        raise ConfigError(msg) from None
    return path
