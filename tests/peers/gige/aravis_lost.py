"""The Aravis back end until the camera is lost; run by a Python that has Aravis' binding. Prints JSON."""

import json
import time

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.gige.aravis import AravisCamera
from fitctl.drivers.interface import DeviceError

overrides = ["camera.device.driver=aravis", "camera.device.heartbeat_s=1.0"]
camera = AravisCamera(load_rig(default_rig_path(), overrides).camera)
camera.open()
camera.start()
frames = 0
last_s = time.monotonic()
found = {}
while time.monotonic() < last_s + 20:
    try:
        frame = camera.next_frame(1.0)
    except DeviceError as error:
        found = {"error": f"{type(error).__name__}: {error}", "after_s": time.monotonic() - last_s}
        break
    if frame is not None:
        frames += 1
        last_s = frame.received_s
camera.close()
print(json.dumps(found | {"frames": frames, "closed": True}))
