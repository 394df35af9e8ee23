"""The local page by real requests: who may ask, what is answered to nonsense, many at once, a full disk, taken ports."""

import http.client
import json
import os
import random
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from fault_harness import disk_with
from hypothesis import strategies as st

from seasonscapes.calibration.annotation import AnnotationSession, save_session
from seasonscapes.calibration.annotation_page import serve_session
from seasonscapes.calibration.terrain_view import march_terrain_view
from seasonscapes.errors import InputError
from seasonscapes.evaluation.calibration_pictures import picture_trial


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    trial = picture_trial(np.random.default_rng(2), size_px=(160, 107), covered=0.0, heading_error_deg=4.0)
    look = partial(march_terrain_view, rasters=trial.rasters, frame=trial.frame, nearest_m=120.0)
    return AnnotationSession("HUT", trial.image, trial.start, trial.frame, look, tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def page(session):
    server, address = serve_session(session)
    yield server.server_address[1], address.partition("=")[2]
    server.shutdown()


def ask(port, method, path, body=None, headers=None, host=None):
    """Status, headers and body of one request; header values as bytes go out as they are."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        sent = {"Host": host or f"127.0.0.1:{port}", **(headers or {})}
        if body is not None and "Content-Length" not in sent:
            sent["Content-Length"] = str(len(body))
        for name, value in sent.items():
            connection.putheader(name, value)
        connection.endheaders(body)
        reply = connection.getresponse()
        return reply.status, dict(reply.getheaders()), reply.read()
    finally:
        connection.close()


def judged(record_property, reply, expected, cases=1):
    """An answer, of a status that is expected, JSON where it refuses."""
    status, headers, body = reply
    wrong = [] if status in expected else ["silent" if status == 200 else "not one line"]
    if status != 200 and not (headers["Content-Type"] == "application/json" and "error" in json.loads(body)):
        wrong.append("no JSON")
    record_property("fault", {"cases": cases, "wrong": wrong})
    assert not wrong, reply
    return reply


WHERE = b'{"terrain": [5, 5]}'
STRANGERS = {
    "no token": ({"X-Token": ""}, None),
    "wrong token": ({"X-Token": "a" * 22}, None),
    "longer token": ({"X-Token": "{token}a"}, None),
    "token that is no text": ({"X-Token": b"\xff\xfe\xe9" * 9}, None),
    "another host": ({"X-Token": "{token}"}, "evil.example"),
    "another host with this port": ({"X-Token": "{token}"}, "evil.example:{port}"),
    "another port": ({"X-Token": "{token}"}, "127.0.0.1:1"),
    "a host without its port": ({"X-Token": "{token}"}, "127.0.0.1"),
    "a host as a prefix": ({"X-Token": "{token}"}, "127.0.0.1.evil.example:{port}"),
    "another origin": ({"X-Token": "{token}", "Origin": "http://evil.example"}, None),
    "null origin": ({"X-Token": "{token}", "Origin": "null"}, None),
    "another scheme": ({"X-Token": "{token}", "Origin": "https://127.0.0.1:{port}"}, None),
    "another port's origin": ({"X-Token": "{token}", "Origin": "http://127.0.0.1:1"}, None),
}


@pytest.mark.parametrize("kind", STRANGERS)
@pytest.mark.parametrize(("method", "path"), [("POST", "/state"), ("POST", "/save"), ("GET", "/photo.jpg")])
def test_strangers_are_refused(page, session, record_property, kind, method, path):
    port, token = page
    headers, host = STRANGERS[kind]
    fill = {"token": token, "port": port}
    headers = {name: value.format(**fill) if isinstance(value, str) else value for name, value in headers.items()}
    if method == "GET":  # its token stands in the address
        given = headers.pop("X-Token")
        path += f"?token={given}" if isinstance(given, str) else "?token=%ff%fe%e9"
    reply = ask(port, method, path, b"{}" if method == "POST" else None, headers, host and host.format(**fill))
    judged(record_property, reply, (403,))
    assert not list(session.folder.iterdir()), "nothing was saved"


BODIES = {
    "no JSON": b"[",
    "a list": b"[]",
    "a number": b"7",
    "not UTF-8": b'{"terrain": "\xff"}',
    "nested": b"[" * 9_000,
    "huge integer": b'{"terrain": [' + b"9" * 5_000 + b", 1]}",
    "NaN": b'{"terrain": [NaN, 1]}',
    "infinite": b'{"terrain": [1e400, 1]}',
    "too few": b'{"terrain": [1]}',
    "too many": b'{"terrain": [1, 2, 3]}',
    "text": b'{"terrain": ["1", "2"]}',
    "truth": b'{"terrain": [true, false]}',
    "null": b'{"terrain": null}',
    "object": b'{"terrain": {"0": 1}}',
    "nothing": b"{}",
    "large": b'{"terrain": [1e300, 1]}',
}


@pytest.mark.parametrize("path", ["/where", "/pick"])
@pytest.mark.parametrize("kind", BODIES)
def test_bodies_that_are_no_request(page, record_property, kind, path):
    port, token = page
    body = BODIES[kind].replace(b'"terrain"', b'"photo": [1, 1], "terrain"') if path == "/pick" else BODIES[kind]
    judged(record_property, ask(port, "POST", path, body, {"X-Token": token}), (400,))


@pytest.mark.parametrize(
    "length", ["-1", "x", "²".encode(), "1e3", "+5", "0x10", "5, 5", "9" * 30, "99999999", "11000"]
)
def test_lengths_that_are_none(page, record_property, length):
    port, token = page
    judged(
        record_property, ask(port, "POST", "/where", WHERE, {"X-Token": token, "Content-Length": length}), (400, 413)
    )


def test_a_request_that_ends_too_soon(page, record_property):
    port, token = page
    with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
        head = f"POST /where HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nX-Token: {token}\r\nContent-Length: 500\r\n\r\n{{}}"
        line.sendall(head.encode())
        line.shutdown(socket.SHUT_WR)
        answer = line.makefile("rb").read()
    record_property("fault", {"cases": 1, "wrong": [] if b" 400 " in answer.split(b"\r\n")[0] else ["no JSON"]})
    assert b" 400 " in answer.split(b"\r\n")[0], answer


@pytest.mark.parametrize(
    ("method", "path", "expected"),
    [
        ("GET", "/../../etc/passwd?token={token}", 404),
        ("GET", "//[?token={token}", 404),
        ("GET", "/%2e%2e/annotation.html?token={token}", 404),
        ("GET", "/?" + "&".join(f"a{n}=1" for n in range(50)), 400),
        ("GET", "/" + "x" * 70_000, 414),
        ("GET", "http://127.0.0.1/?token={token}", 404),
        ("POST", "/nothing", 404),
        ("POST", "/../save", 404),
        ("PUT", "/save", 501),
        ("DELETE", "/state", 501),
        ("OPTIONS", "/state", 501),
    ],
)
def test_addresses_that_are_none(page, record_property, method, path, expected):
    port, token = page
    reply = ask(port, method, path.format(token=token), b"{}" if method == "POST" else None, {"X-Token": token})
    # An absolute address names the page itself.
    judged(record_property, reply, (expected, 200) if path.startswith("http") else (expected,))


def test_what_is_sent_may_run_nothing_but_the_page(page):
    port, token = page
    status, headers, body = ask(port, "GET", f"/?token={token}")
    policy = headers["Content-Security-Policy"]
    nonce = policy.partition("script-src 'nonce-")[2].partition("'")[0]
    assert status == 200
    assert "unsafe-inline" not in policy
    assert f'<script nonce="{nonce}">'.encode() in body
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Cache-Control"] == "no-store"
    assert ask(port, "GET", f"/?token={token}")[2] != body, "each page has its own nonce"


def test_forty_at_once_are_answered(page, record_property):
    port, token = page
    start = threading.Barrier(40)

    def one(number):
        start.wait()
        if number % 2:
            return ask(port, "POST", "/where", WHERE, {"X-Token": token})[0]
        return ask(port, "GET", f"/photo.jpg?token={token}")[0]

    with ThreadPoolExecutor(40) as many:
        answers = list(many.map(one, range(40)))
    record_property("fault", {"cases": 40, "wrong": [] if set(answers) == {200} else ["not one line"]})
    assert answers == [200] * 40


def test_a_disk_without_space_is_told_to_the_page(page, session, record_property):
    port, token = page
    with disk_with(10):
        reply = ask(port, "POST", "/save", b"{}", {"X-Token": token})
    judged(record_property, reply, (500,))
    assert b"not saved" in reply[2]
    assert not list(session.folder.iterdir()), "nothing half is left"


def test_a_folder_that_became_a_file_is_told_to_the_page(page, session, record_property):
    port, token = page
    folder = session.folder
    folder.rmdir()
    folder.write_text("a file now")
    try:
        judged(record_property, ask(port, "POST", "/save", b"{}", {"X-Token": token}), (500,))
    finally:
        folder.unlink()
        folder.mkdir()
    assert save_session(session)[0].is_file()
    for path in folder.iterdir():
        path.unlink()


@pytest.mark.parametrize("port", [-1, 65536, 99999, 10**12, "taken", "forbidden"])
def test_ports_that_cannot_be_had(page, session, record_property, port):
    if port == "forbidden" and os.geteuid() == 0:
        pytest.skip("root may use all ports")
    number = {"taken": page[0], "forbidden": 1}.get(port, port)
    record_property("fault", {"cases": 1, "wrong": []})
    with pytest.raises(InputError, match="--port"):
        serve_session(session, port=number)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
PIXEL = st.one_of(JSON, st.lists(st.floats() | st.integers(-50, 200), min_size=2, max_size=2))


REQUEST = st.tuples(
    st.sampled_from(["/state", "/where", "/pick", "/undo", "/solve"]) | st.text(max_size=20).map(ascii),
    st.one_of(
        st.binary(max_size=200),
        JSON.map(lambda value: json.dumps(value).encode()),
        st.fixed_dictionaries({}, optional={"photo": PIXEL, "terrain": PIXEL}).map(lambda v: json.dumps(v).encode()),
    ),
    st.dictionaries(
        st.sampled_from(["Content-Type", "Origin", "X-Other", "Accept", "Transfer-Encoding"]),
        st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=30),
        max_size=3,
    ),
)


def test_any_request_is_answered(page, record_property, fuzz):
    port, token = page

    def answered(request):
        path, body, headers = request
        address = "/" + path.strip("/' ").replace(" ", "")
        status, sent, text = ask(port, "POST", address, body, {"X-Token": token, **headers})
        assert status in (200, 400, 403, 404)
        assert sent["Content-Type"] == "application/json"
        json.loads(text, parse_constant=pytest.fail)

    record_property("fault", {"cases": fuzz(REQUEST, answered), "wrong": []})


def test_a_session_survives_random_clicks(page, session, record_property):
    """Whatever is picked, undone and solved in whatever order, the state remains whole."""
    port, token = page
    rng = random.Random(1)
    height, width = session.image.shape[:2]
    for _ in range(60):
        path = rng.choice(["/pick", "/pick", "/pick", "/undo", "/solve", "/where"])
        pixels = {"photo": [rng.uniform(-5, width + 5), rng.uniform(-5, height + 5)]}
        pixels["terrain"] = [rng.uniform(-5, width + 5), rng.uniform(-5, height + 5)]
        judged(record_property, ask(port, "POST", path, json.dumps(pixels).encode(), {"X-Token": token}), (200, 400))
    state = json.loads(ask(port, "POST", "/state", b"{}", {"X-Token": token})[2])
    assert len(state["pairs"]) == len(session.pixel)
