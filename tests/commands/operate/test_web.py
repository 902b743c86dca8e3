"""`fitctl console --web`: a page is for who has its key, and the key goes nowhere else."""

import http.client
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from urllib.parse import urlsplit

import pytest
from instruments.served import free_port

LIMIT_S = 60.0

pytest.importorskip("textual_serve")


def console_on(port, folder):
    """The command that serves consoles on a port."""
    command = [sys.executable, "-m", "fitctl", "console", "--web", "--port", str(port)]
    return [*command, "--set", f"service.folder={folder / 's'}"]


@pytest.fixture(scope="module")
def serve(tmp_path_factory):
    """Starts consoles for browsers; gives the address of each."""
    with ExitStack() as stack:

        def start():
            server = subprocess.Popen(
                console_on(free_port(), tmp_path_factory.mktemp("w")),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                text=True,
            )
            stack.callback(server.stdout.close)
            stack.callback(server.wait, LIMIT_S)
            stack.callback(server.terminate)
            address = server.stdout.readline().split()[1]
            listens(address)  # it is printed before
            return address

        yield start


def listens(address):
    parts, end_s = urlsplit(address), time.monotonic() + LIMIT_S
    while time.monotonic() < end_s:
        try:
            return socket.create_connection((parts.hostname, parts.port), LIMIT_S).close()
        except ConnectionRefusedError:
            time.sleep(0.05)
    raise AssertionError("it does not listen")


def ask(address, path=None, **headers):
    """Status and headers of an answer."""
    return answered(address, path, **headers)[:2]


def answered(address, path=None, **headers):
    """Status, headers and content of an answer."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=LIMIT_S)
    try:
        connection.request("GET", parts.path if path is None else path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


@pytest.fixture(scope="module")
def page(serve):
    return serve()


def test_who_has_the_address_gets_the_page_and_all_of_its_parts(page):
    key = urlsplit(page).path

    assert ask(page)[0] == 200
    assert ask(page, f"{key}static/js/textual.js")[0] == 200


def test_the_page_takes_keys_before_a_click(page):
    content = answered(page)[2].decode()
    assert ".focus()" in content.rpartition('id="terminal"')[2]


def test_who_has_no_key_gets_nothing(page):
    key = urlsplit(page).path.strip("/")

    for path in (
        "/",
        "/ws",
        "/static/js/textual.js",
        f"/{key[:-1]}{'y' if key.endswith('x') else 'x'}/",  # one character is another
        f"/?key={key}",
        f"//{key}/",
    ):
        assert ask(page, path)[0] == 403, path
    assert ask(page, Origin="http://elsewhere.example")[0] == 403
    assert ask(page, Host="elsewhere.example")[0] == 403


def upgraded(address, **headers):
    """Status of an answer to a browser that opens the console's WebSocket."""
    parts = urlsplit(address)
    given = {
        "Host": parts.netloc,
        "Origin": f"http://{parts.netloc}",
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    } | headers
    lines = "".join(f"{name}: {value}\r\n" for name, value in given.items())
    with socket.create_connection((parts.hostname, parts.port), LIMIT_S) as line:
        line.sendall(f"GET {parts.path}ws?width=80&height=24 HTTP/1.1\r\n{lines}\r\n".encode())
        return int(line.makefile("rb").readline().split()[1])


def test_a_page_of_another_site_opens_no_socket_even_with_the_key(page):
    port = urlsplit(page).port
    for origin in (
        "http://elsewhere.example",
        f"http://localhost:{port}",
        f"https://127.0.0.1:{port}",
        "http://127.0.0.1:1",
        "null",
    ):
        assert upgraded(page, Origin=origin) == 403, origin


def test_a_name_that_was_rebound_to_this_machine_opens_no_socket_even_with_the_key(page):
    """The page of that name is of the same origin to its browser, which sends the name as Host."""
    port = urlsplit(page).port
    for name in (f"elsewhere.example:{port}", f"localhost:{port}", "127.0.0.1"):
        assert upgraded(page, Host=name, Origin=f"http://{name}") == 403, name
        assert upgraded(page, Host=name) == 403, name


def test_the_console_s_own_page_opens_its_socket(page):
    assert upgraded(page) == 101


@pytest.mark.parametrize("key", [b"\xc3\xa9", b"%C3%A9", b"\xff\xfe", b"%ff%00", b"?key=\xc3\xa9"])
def test_a_key_that_is_no_ascii_is_refused_and_is_no_error_of_the_server(page, key):
    parts = urlsplit(page)
    with socket.create_connection((parts.hostname, parts.port), LIMIT_S) as line:
        line.sendall(b"GET /" + key + b" HTTP/1.1\r\nHost: " + parts.netloc.encode() + b"\r\n\r\n")
        status = int(line.makefile("rb").readline().split()[1])

    assert status in {400, 403}


@pytest.mark.long
def test_a_browser_is_given_nothing_that_it_would_show_another_port(page):
    """A cookie of 127.0.0.1 goes to every port there, so also to another user's server."""
    _, headers = ask(page)

    assert "Set-Cookie" not in headers
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "default-src 'self'" in headers["Content-Security-Policy"]


@pytest.mark.long
def test_two_consoles_do_not_log_each_other_out(serve):
    first, second = serve(), serve()

    assert ask(first)[0] == ask(second)[0] == ask(first)[0] == 200
    assert ask(first, urlsplit(second).path)[0] == 403


def test_a_port_that_another_server_has_gives_one_line_and_no_address(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        ended = subprocess.run(
            console_on(port, tmp_path),
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )

    assert ended.returncode == 2
    assert ended.stdout == ""
    assert f"console --web: port {port}: Address already in use; choose another" in ended.stderr
