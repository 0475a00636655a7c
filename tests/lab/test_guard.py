"""Who may ask."""

import pytest

from phongfit.lab.guard import Guard

OURS = "127.0.0.1:8060"


async def _nobody(scope, receive, send):
    raise AssertionError("nobody is asked here")


@pytest.mark.parametrize(
    "listens, headers, words",
    [
        ("127.0.0.1", {"host": OURS}, None),
        ("127.0.0.1", {"host": "localhost:8060"}, None),
        ("127.0.0.1", {"host": OURS, "origin": f"http://{OURS}"}, None),
        ("127.0.0.1", {"host": OURS, "sec-fetch-site": "same-origin"}, None),
        ("127.0.0.1", {"host": OURS, "sec-fetch-site": "none"}, None),
        ("::1", {"host": "[::1]:8060"}, None),
        # A site that gave its own name this machine's address.
        ("127.0.0.1", {"host": "evil.example:8060"}, "host"),
        ("127.0.0.1", {"host": "127.0.0.1.evil.example"}, "host"),
        ("127.0.0.1", {"host": "192.168.0.7:8060"}, "host"),
        ("127.0.0.1", {"host": "[::1"}, "host"),
        ("127.0.0.1", {"host": ""}, "host"),
        ("127.0.0.1", {}, "host"),
        # A page of another site, of another port, or of no site.
        ("127.0.0.1", {"host": OURS, "origin": "http://evil.example"}, "origin"),
        ("127.0.0.1", {"host": OURS, "origin": "http://127.0.0.1:9"}, "origin"),
        ("127.0.0.1", {"host": OURS, "origin": f"https://{OURS}"}, "origin"),
        ("127.0.0.1", {"host": OURS, "origin": "null"}, "origin"),
        ("127.0.0.1", {"host": OURS, "sec-fetch-site": "cross-site"}, "sec-fetch"),
        ("127.0.0.1", {"host": OURS, "sec-fetch-site": "same-site"}, "sec-fetch"),
        # Asked to let other machines in: by address, and still by no foreign name.
        ("0.0.0.0", {"host": "192.168.0.7:8060"}, None),
        ("0.0.0.0", {"host": "[fe80::1]:8060"}, None),
        ("lab.example", {"host": "lab.example:8060"}, None),
        ("0.0.0.0", {"host": "evil.example:8060"}, "host"),
        ("0.0.0.0", {"host": OURS, "origin": "http://evil.example"}, "origin"),
    ],
)
def test_refusals(listens, headers, words):
    reason = Guard(_nobody, listens).refusal(headers)
    assert reason is None if words is None else (reason or "").startswith(words)
