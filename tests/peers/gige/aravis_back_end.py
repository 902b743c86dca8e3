"""The Aravis back end on the mock camera; run by a Python that has Aravis' binding. Prints JSON."""

import json
import sys

import numpy as np
from gige_alone import image

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.gige.aravis import AravisCamera
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import DeviceMismatch, DeviceRefused

settings = load_rig(default_rig_path(), ["camera.device.driver=aravis", *sys.argv[1:]]).camera
camera = AravisCamera(settings)
identity = camera.open()
camera.start()
frames = [frame for _ in range(50) if (frame := camera.next_frame(2.0)) is not None]
counts = camera.counts()
found = {
    "model": identity.model,
    "numbers": [frame.number for frame in frames],
    "ages_s": [frame.received_s - frame.mid_exposure_s for frame in frames],
    "same": all(np.array_equal(frame.image, image()) for frame in frames),
    "lost": counts.lost,
    "packets_lost": counts.packets_lost,
}
camera.set_frame_rate(25.0)
slower = [frame for _ in range(10) if (frame := camera.next_frame(2.0)) is not None]
found["slower_s"] = np.diff([frame.mid_exposure_s for frame in slower])[-4:].tolist()
try:
    camera.set_frame_rate(1e6)
except DeviceMismatch as error:
    found["too fast"] = str(error)
for kind in (AravisCamera, GigeCamera):
    second = kind(settings)
    try:
        second.open()
    except DeviceRefused as error:
        found[kind.__name__] = str(error)
    second.close()
camera.close()
wide = settings.model_copy(update={"width_px": 64})
try:
    AravisCamera(wide).open()
except DeviceMismatch as error:
    found["wide"] = str(error)
camera.open()  # control was given up each time
camera.close()
camera.close()
print(json.dumps(found))
