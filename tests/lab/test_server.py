"""The server as the network sees it."""

import http.client
import json

import pytest

from phongfit.lab.server import ASSETS
from tests.helpers import said


def _ask(port, path, body=None, method=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    method = method or ("GET" if body is None else "POST")
    connection.request(method, path, body, headers)
    response = connection.getresponse()
    content = response.read()
    connection.close()
    return response, content


def _complaint(port, path, body, **headers) -> str:
    response, content = _ask(port, path, body, **headers)
    assert response.status in (400, 403)
    (words,) = json.loads(content).values()
    assert "\n" not in words
    return words


@pytest.mark.parametrize("path", ASSETS)
def test_the_page_needs_nothing_from_elsewhere(port, path):
    response, content = _ask(port, path)
    assert response.status == 200
    policy = response.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "script-src 'self'" in policy
    assert response.headers["x-content-type-options"] == "nosniff"
    text = content.decode().replace("http://www.w3.org/2000/svg", "")
    assert "http" not in text and "//cdn" not in text


def test_a_picture(port):
    response, content = _ask(port, "/api/picture", json.dumps({"settings": {}}))
    assert response.status == 200 and content.startswith(b"\x89PNG")
    assert response.headers["content-type"] == "image/png"


@pytest.mark.parametrize(
    "path, body, words",
    [
        ("/api/picture", "", "is no JSON"),
        ("/api/picture", b"\xff", "is no JSON"),
        (
            "/api/picture",
            '{"settings": {"turn": 900}}',
            "settings.turn: expected ... got 900",
        ),
        ("/api/picture", '{"settings": {"surface": "x"}}', "mesh: is no longer held"),
        ("/api/fit", '{"settings": {}, "target": "x"}', "target: is no longer held"),
        ("/api/mesh?name=a.obj", "v 1 2\nf 1 2 3", "line 1: v: expected 3 finite"),
        ("/api/mesh", "", "name: is missing"),
        ("/api/photograph?name=a.png", "", "encoding: is missing"),
        ("/api/photograph?name=a.png&encoding=hdr", "", "got 'hdr'"),
        ("/api/photograph?name=a.png&encoding=srgb", "PNG", "a.png: is broken"),
        ("/api/mask?name=a.png&target=x", "", "target: is no longer held"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(port, path, body, words):
    assert said(words, _complaint(port, path, body))


def test_requests_from_elsewhere(port):
    ours = json.dumps({"settings": {}})
    told = _complaint(port, "/api/picture", ours, Host="evil.example")
    assert "host: 'evil.example'" in told
    told = _complaint(port, "/api/picture", ours, Origin="http://evil.example")
    assert "origin: requests from 'http://evil.example'" in told
    assert _ask(port, "/", Host="evil.example")[0].status == 403
    preflight, _ = _ask(
        port, "/api/picture", method="OPTIONS", Origin="http://evil.example"
    )
    assert preflight.status == 403
    assert "access-control-allow-origin" not in preflight.headers


def test_unknown_addresses(port):
    assert _ask(port, "/../pyproject.toml")[0].status == 404
    assert _ask(port, "/api/fit")[0].status == 405
