"""A TCP server on a thread of its own, for devices whose every answer a test decides."""

import contextlib
import socket
import threading


@contextlib.contextmanager
def scripted_server(talk):
    """Have `talk(client)` serve one connection after the other; gives the port."""

    def serve():
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                with client, contextlib.suppress(OSError):
                    talk(client)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join(5)
