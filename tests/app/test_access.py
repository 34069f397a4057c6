"""Only pages of the server itself, on this machine and with the token, get an answer."""

import asyncio

import pytest

from dem_jax.app.access import AccessGuard

PORT, TOKEN = 8123, "right-token"
HOST = f"127.0.0.1:{PORT}"
COOKIE = f"dem_jax_{PORT}={TOKEN}"


async def page(scope, receive, send):
    """An application that reads the whole body and answers."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    size = 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return
        size += len(message.get("body", b""))
        if not message.get("more_body"):
            break
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": str(size).encode()})


def ask(kind="http", path="/", query="", chunks=(b"",), **headers):
    """What the guard sends for a request."""
    sent, bodies = [], list(chunks)

    async def receive():
        return {"type": "http.request", "body": bodies.pop(0), "more_body": bool(bodies)}

    async def send(message):
        sent.append(message)

    head = {"host": HOST} | {name.replace("_", "-"): value for name, value in headers.items()}
    raw = [(name.encode(), value.encode()) for name, value in head.items() if value is not None]
    scope = {"type": kind, "path": path, "query_string": query.encode(), "headers": raw}
    asyncio.run(AccessGuard(page, TOKEN, PORT, largest=100)(scope, receive, send))
    return sent


def status(sent):
    return sent[0]["status"]


def test_the_token_in_the_address_becomes_a_cookie_and_leaves_the_address():
    sent = ask(path="/drop", query=f"a=1&token={TOKEN}")
    headers = dict(sent[0]["headers"])
    assert status(sent) == 303 and headers[b"location"] == b"/drop?a=1"
    assert headers[b"set-cookie"] == f"{COOKIE}; HttpOnly; SameSite=Strict; Path=/".encode()
    assert status(ask(cookie=COOKIE)) == 200


def test_an_address_with_two_slashes_leads_nowhere_else():
    location = dict(ask(path="//example.org", query=f"token={TOKEN}")[0]["headers"])[b"location"]
    assert location == b"/example.org"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"cookie": f"dem_jax_{PORT}=wrong"},
        {"cookie": f"dem_jax_{PORT + 1}={TOKEN}"},
        {"cookie": "\x01;;="},
    ],
)
def test_without_the_token_nothing_is_shown(headers):
    assert status(ask(**headers)) == 401
    assert status(ask(query="token=wrong", **headers)) == 401


@pytest.mark.parametrize(
    "host", ["example.org", f"example.org:{PORT}", "127.0.0.1:80", f"0.0.0.0:{PORT}", None]
)
def test_a_name_that_was_pointed_at_this_machine_is_refused(host):
    assert status(ask(host=host, cookie=COOKIE)) == 421


@pytest.mark.parametrize(
    "origin", ["http://example.org", "null", "http://127.0.0.1:80", f"https://{HOST}", ""]
)
def test_requests_of_other_origins_are_refused(origin):
    assert status(ask(origin=origin, cookie=COOKIE)) == 403
    assert ask("websocket", origin=origin, cookie=COOKIE)[0]["type"] == "websocket.close"


@pytest.mark.parametrize("site", ["same-site", "cross-site"])
@pytest.mark.parametrize("dest", ["image", "script", "iframe", "empty", None])
def test_what_pages_of_other_servers_load_is_refused_though_it_has_the_cookie(site, dest):
    assert status(ask(sec_fetch_site=site, sec_fetch_dest=dest, cookie=COOKIE)) == 403


def test_a_person_and_own_pages_may_load():
    assert status(ask(sec_fetch_site="none", sec_fetch_dest="document", cookie=COOKIE)) == 200
    assert status(ask(sec_fetch_site="same-origin", sec_fetch_dest="iframe", cookie=COOKIE)) == 200
    link = {"sec_fetch_site": "cross-site", "sec_fetch_dest": "document"}  # as in a terminal's page
    assert status(ask(query=f"token={TOKEN}", **link)) == 303
    assert status(ask(**link)) == 401


def test_a_socket_needs_origin_and_token():
    own = f"http://{HOST}"
    assert ask("websocket", cookie=COOKIE, origin=own)[0]["type"] == "websocket.accept"
    assert ask("websocket", cookie=COOKIE)[0]["type"] == "websocket.close"
    assert ask("websocket", origin=own)[0]["type"] == "websocket.close"


def test_a_request_that_is_too_large_is_refused_whatever_it_says_of_its_size():
    assert ask(chunks=(b"x" * 100,), cookie=COOKIE)[1]["body"] == b"100"
    assert status(ask(content_length="101", cookie=COOKIE)) == 413
    assert status(ask(content_length="-1", cookie=COOKIE)) == 413
    assert ask(chunks=(b"x" * 60, b"x" * 60), cookie=COOKIE) == []


def test_each_answer_forbids_frames_of_others_and_loads_nothing_from_elsewhere():
    for sent in (ask(cookie=COOKIE), ask()):
        headers = dict(sent[0]["headers"])
        assert headers[b"x-frame-options"] == b"SAMEORIGIN"
        assert headers[b"cross-origin-resource-policy"] == b"same-origin"
        assert b"default-src 'self'" in headers[b"content-security-policy"]
