"""How long the machine stood still while a test ran: what is excused, and no more."""

import threading
import time
from contextlib import contextmanager

LOOK_S = 0.005
STALL_S = 0.02  # less is no stall
# Interlocks that trip where this computer, or the host of a virtual one, gives fitctl too little time.
BUSY = {"servo_overrun", "loop_overrun", "frame_age"}


class Stalls:
    """What this process was kept from running, once and in all."""

    def __init__(self):
        self.worst_s = 0.0
        self.total_s = 0.0


@contextmanager
def stalls():
    """Watch for stalls of the machine."""
    seen, ending = Stalls(), threading.Event()

    def watch():
        before_s = time.monotonic()
        while not ending.wait(LOOK_S):
            now_s = time.monotonic()
            stood_s = now_s - before_s - LOOK_S
            seen.worst_s = max(seen.worst_s, stood_s)
            seen.total_s += stood_s if stood_s > STALL_S else 0.0
            before_s = now_s

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield seen
    finally:
        ending.set()
        thread.join()
