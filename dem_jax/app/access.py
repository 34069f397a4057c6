"""Who may use the server: its own pages, on this machine, with the token of its address."""

import hmac
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qsl, urlencode

Scope = dict[str, Any]
LARGEST_REQUEST = 64 * 2**20  # bytes; the largest upload and its form
POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'self'; "
    "form-action 'self'; base-uri 'self'; object-src 'none'"
)
HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"SAMEORIGIN"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
REFUSED = "Requests of other pages are refused."
OWN_SITES = ("same-origin", "none")  # of Sec-Fetch-Site: a page of the server, or the person


class AccessGuard:
    """ASGI middleware that refuses requests of other hosts and origins, without the token, or too
    large.

    The first request carries the token in its address (``?token=...``); the answer stores it in a
    cookie that scripts cannot read and other sites cannot send, and redirects to the plain address.
    """

    def __init__(self, app: Any, token: str, port: int, largest: int = LARGEST_REQUEST) -> None:
        self._app = app
        self._token = token
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self._cookie = f"dem_jax_{port}"
        self._largest = largest

    async def __call__(self, scope: Scope, receive: Any, send: Any) -> None:
        """Pass a request on, or answer it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        refusal = self._refuse(scope, headers)
        if refusal is not None:
            await _answer(scope, send, *refusal)
        elif scope["type"] == "http" and (target := self._find_redirect(scope)) is not None:
            kept = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
            await _answer(
                scope,
                send,
                303,
                "",
                [(b"location", target.encode()), (b"set-cookie", kept.encode())],
            )
        elif not self._is_known(headers):
            words = "This page needs the address that dem-jax app printed, with its token."
            await _answer(scope, send, 401, words)
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            await self._app(scope, _limited(receive, self._largest), _with_headers(send))

    def _refuse(self, scope: Scope, headers: dict[str, str]) -> tuple[int, str] | None:
        """Status and reason of a request that is refused whoever sends it; None: it is not."""
        if headers.get("host") not in self._hosts:
            return 421, "This server answers on 127.0.0.1 only."
        origin = headers.get("origin")
        if origin is not None or scope["type"] == "websocket":
            if origin not in {f"http://{host}" for host in self._hosts}:
                return 403, REFUSED
        # Cookies know no port: the pages of other servers on this machine send ours along, without
        # an origin where they load a picture or a script.
        is_own = headers.get("sec-fetch-site", "none") in OWN_SITES
        if not is_own and headers.get("sec-fetch-dest") != "document":
            return 403, REFUSED
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > self._largest:
            return 413, f"A request may have up to {self._largest} bytes."
        return None

    def _find_redirect(self, scope: Scope) -> str | None:
        """The address without the token, of a request with the right token in its address."""
        query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        given = dict(query).get("token")
        if given is None or not self._is_token(given):
            return None
        rest = urlencode([(key, value) for key, value in query if key != "token"])
        path = "/" + scope["path"].lstrip("/")
        return f"{path}?{rest}" if rest else path

    def _is_known(self, headers: dict[str, str]) -> bool:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        return self._cookie in cookies and self._is_token(cookies[self._cookie].value)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token.encode())


async def _answer(
    scope: Scope, send: Any, status: int, words: str, headers: Iterable[tuple[bytes, bytes]] = ()
) -> None:
    """Answer a request with a line of text; a socket is closed before it opens."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": words})
        return
    plain = (b"content-type", b"text/plain; charset=utf-8")
    await send(
        {"type": "http.response.start", "status": status, "headers": [plain, *HEADERS, *headers]}
    )
    await send({"type": "http.response.body", "body": words.encode()})


def _limited(receive: Any, largest: int) -> Any:
    """``receive`` that ends a request whose body is too large, whatever its header says."""
    total = 0

    async def limited() -> Any:
        nonlocal total
        message = await receive()
        total += len(message.get("body", b""))
        return {"type": "http.disconnect"} if total > largest else message

    return limited


def _with_headers(send: Any) -> Any:
    """``send`` that adds the headers of every answer."""

    async def with_headers(message: Any) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", []), *HEADERS]}
        await send(message)

    return with_headers
