"""Refuse requests for other host names and from other sites."""

import ipaddress
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# The page loads only content of this server.
POLICY = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}


class Guard:
    """Middleware that accepts only requests of the server's own page.

    A page of another site could send requests to this machine through the user's
    browser; the headers `Origin` and `Sec-Fetch-Site` state the source of a request. A
    site could also map its own name to this machine's address, which makes it the same
    origin; but `Host` then contains that name.
    """

    def __init__(self, app: ASGIApp, host: str):
        """**Arguments:** `host`: address at which the server listens."""
        self.app = app
        self.names = known_names(host)
        self.local = is_loopback(host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return

        async def send_with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                pairs = [(k.encode(), v.encode()) for k, v in POLICY.items()]
                message["headers"] = [*message["headers"], *pairs]
            await send(message)

        reason = self.refusal(Headers(scope=scope))
        if reason is None:
            await self.app(scope, receive, send_with_policy)
        else:
            answer = JSONResponse({"error": reason}, status_code=403)
            await answer(scope, receive, send_with_policy)

    def refusal(self, headers: Mapping[str, str]) -> str | None:
        """The reason to refuse a request with these headers, or `None`."""
        host = headers.get("host", "")
        if not self._is_ours(_hostname(f"//{host}")):
            return f"host: {host!r} is not a name of this server"
        origin = headers.get("origin")
        if origin is not None and origin != f"http://{host}":
            return f"origin: requests from {origin!r} are refused"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "sec-fetch-site: requests from other sites are refused"
        return None

    def _is_ours(self, name: str) -> bool:
        # A site's name cannot be an IP address.
        return name in self.names or (not self.local and _is_address(name))


def known_names(host: str) -> frozenset[str]:
    """Names by which a browser may reach a server that listens at `host`."""
    names = {host.lower(), "localhost", "127.0.0.1", "::1"}
    if not is_loopback(host):
        names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return frozenset(names)


def is_loopback(host: str) -> bool:
    """True if `host` can be reached only from this machine."""
    if host == "localhost":
        return True
    return _is_address(host) and ipaddress.ip_address(host).is_loopback


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _hostname(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""
