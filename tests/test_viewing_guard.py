"""Where the page of a run listens, and whom it answers."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path

import pytest
from command_line import assert_one_line, mixpose

from mixpose.cli.help import with_values
from mixpose.errors import SessionError
from mixpose.viewing.address import Guard, Place, listen

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
LOCAL = Guard(8080, None)
OPEN = Guard(8080, "right")


def listening(text: str) -> Iterator[Place]:
    place = listen(text)
    yield place
    place.socket.close()


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that something else listens at."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield int(other.getsockname()[1])


def test_a_port_alone_is_open_to_this_machine_only() -> None:
    for place in listening("0"):
        assert place.socket.getsockname()[0] == "127.0.0.1"
        assert place.token is None
        assert place.address == f"http://127.0.0.1:{place.port}/"


def test_a_page_open_to_others_has_an_address_that_cannot_be_guessed() -> None:
    addresses = set()
    for _ in range(2):
        for place in listening("0.0.0.0:0"):
            # 128 random bits in base 64
            assert re.fullmatch(r"http://\S+:\d+/\?token=[\w-]{22}", place.address)
            addresses.add(place.address.partition("=")[2])
    assert len(addresses) == 2


def test_loopback_by_its_number_needs_no_token() -> None:
    for place in listening("127.0.0.1:0"):
        assert place.token is None


def test_without_a_port_another_is_taken_where_the_usual_one_is_not_free() -> None:
    for first in listening(""):
        for second in listening(""):
            assert first.port != second.port


@pytest.mark.parametrize("text", ["x", "70000", "1.2.3.4", ":80", "host:", "8080/", "-1"])
def test_what_is_no_port_is_refused_with_what_is_allowed(text: str) -> None:
    with pytest.raises(SessionError, match=r"found no port; allowed are a port \(8080;"):
        listen(text)


@pytest.mark.parametrize("text", ["a..b:80", ".a:80", f"{'a' * 64}:80"])
def test_what_can_be_no_host_is_refused_with_what_is_allowed(text: str) -> None:
    with pytest.raises(SessionError, match=r"found no host '.*'; allowed are a port \(8080;"):
        listen(text)


def test_a_port_that_is_taken_is_refused_not_replaced(taken: int) -> None:
    with pytest.raises(SessionError, match=r"cannot listen there: .*name another port"):
        listen(str(taken))


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:9000", "[::1]:8080", "localhost"])
def test_this_machine_may_open_the_page_under_each_of_its_names(host: str) -> None:
    assert LOCAL.answer("/", {"Host": host}) is None
    assert LOCAL.answer("/", {"Host": host, "Origin": f"http://{host}"}) is None


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example:8080"},  # a name of another site that leads here
        {},
        {"Host": "127.0.0.1:8080", "Origin": "http://evil.example"},
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8081"},
        {"Host": "127.0.0.1:8080", "Origin": "null"},
    ],
)
def test_pages_of_other_sites_do_not_get_at_it(headers: dict[str, str]) -> None:
    answer = LOCAL.answer("/", headers)
    assert answer is not None
    assert answer.status == HTTPStatus.FORBIDDEN


def test_the_token_opens_the_page_once_and_the_cookie_from_then_on() -> None:
    answer = OPEN.answer("/?token=right", {"Host": "lab:8080"})
    assert answer is not None
    assert (answer.status, answer.headers["Location"]) == (HTTPStatus.SEE_OTHER, "/")
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Lax" in cookie
    own = cookie.partition(";")[0]
    # browsers send cookies of all ports, and other services put there what no standard allows
    for sent in (own, f'theme={{"dark": 1}}; {own}', f"{own}; a[b]=c d"):
        assert OPEN.answer("/", {"Host": "lab:8080", "Cookie": sent}) is None


@pytest.mark.parametrize(
    ("target", "cookie"),
    [
        ("/", ""),
        ("/?token=wrong", ""),
        ("/?token=", ""),
        ("/?token=%C3%A4", ""),
        ("/", "mixpose-view-8080=wrong"),
        ("/", "mixpose-view-8081=right"),  # of another run
        ("/", "=;=;\x00"),
    ],
)
def test_without_the_token_nobody_gets_in(target: str, cookie: str) -> None:
    answer = OPEN.answer(target, {"Host": "lab:8080", "Cookie": cookie})
    assert answer is not None
    assert answer.status == HTTPStatus.FORBIDDEN
    other = OPEN.answer(
        "/",
        {"Host": "lab:8080", "Cookie": "mixpose-view-8080=right", "Origin": "http://evil.example"},
    )
    assert other is not None
    assert other.status == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize(
    ("typed", "taken"),
    [
        (["run", "s.toml", "--view"], ["run", "s.toml", "--view="]),
        (["run", "--view", "s.toml"], ["run", "--view=", "s.toml"]),
        (["run", "--view", "-o", "p"], ["run", "--view=", "-o", "p"]),
        (["run", "--view", "8081", "s.toml"], ["run", "--view", "8081", "s.toml"]),
        (["run", "--view", "0.0.0.0:0"], ["run", "--view", "0.0.0.0:0"]),
        (["run", "--view=8081"], ["run", "--view=8081"]),
    ],
)
def test_the_port_of_view_may_be_left_out(typed: list[str], taken: list[str]) -> None:
    assert with_values(typed) == taken


def test_a_run_whose_page_has_no_place_is_not_begun(tmp_path: Path, taken: int) -> None:
    session = SYNTHETIC / "two_cameras" / "session.toml"
    poses = tmp_path / "poses.jsonl"
    result = mixpose("run", session, "--view", str(taken), "-o", poses)
    assert_one_line(result, 2, f"--view {taken}: cannot listen there")
    assert not poses.exists()
