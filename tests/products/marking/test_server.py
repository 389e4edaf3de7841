"""The server answers its own page on this computer, and nobody else."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sfm.model.errors import FolderInUseError, OutputError, SurveyFileError
from sfm.products.marking.project import project_of_folder
from sfm.products.marking.server import MarkingServer
from sfm.products.marking.session import MarkingSession
from sfm.survey.inputs.marks_file import Marking, read_marks, write_marks
from tests.products.marking.photographs import write_photographs


@dataclass(frozen=True)
class Served:
    server: MarkingServer
    marks: Path
    dots: Any  # px, (m, n, 2)

    def ask(
        self, path: str, body: Any = None, *, secret: str | None = None, **headers: str | None
    ) -> tuple[int, bytes]:
        """Return status and content; a header that is None is not sent."""
        address = self.server.address
        connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=30)
        usual: dict[str, str | None] = {"Host": f"127.0.0.1:{address.port}"}
        if body is not None:
            usual |= {"X-Kolinear": address.secret, "Content-Type": "application/json"}
        usual |= {name.replace("_", "-"): value for name, value in headers.items()}
        data = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
        connection.putrequest(
            "GET" if data is None else "POST", f"/{secret or address.secret}/{path}", skip_host=True
        )
        for name, value in usual.items():
            if value is not None:
                connection.putheader(name, value)
        if data is not None:
            connection.putheader("Content-Length", str(len(data)))
        connection.endheaders(data)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, content

    def state(self, path: str = "state") -> dict[str, Any]:
        status, content = self.ask(path)
        assert status == 200
        found: dict[str, Any] = json.loads(content)
        return found


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("photographs")
    dots = write_photographs(folder, np.random.default_rng(1))
    marks = tmp_path_factory.mktemp("marks") / "marks.csv"
    session = MarkingSession(project_of_folder(folder), marks)
    server = MarkingServer(session)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    for _ in range(500):
        with socket.socket() as trial:
            if trial.connect_ex(("127.0.0.1", server.address.port)) == 0:
                break
        time.sleep(0.01)
    yield Served(server, marks, dots)
    server.stop()
    session.close()
    thread.join(10)
    assert not thread.is_alive()


def click(served: Served, image: int, dot: int, point: str | None = None) -> dict[str, Any]:
    x, y = served.dots[image, dot]
    status, content = served.ask("click", {"image": image, "x": x + 2.0, "y": y - 1.0, "point": point})
    assert status == 200, content
    answer: dict[str, Any] = json.loads(content)
    return answer


def last(served: Served, step: str) -> dict[str, Any]:
    return {"number": served.state()[step]["number"]}


def test_a_click_measures_saves_and_is_undone(served: Served) -> None:
    answer = click(served, 0, 4)
    mark = answer["mark"]
    assert mark["kind"] == "target"
    assert np.hypot(mark["x"] - served.dots[0, 4, 0], mark["y"] - served.dots[0, 4, 1]) < 0.2
    saved = read_marks(served.marks)
    assert [(row.photograph, row.point, row.x) for row in saved.marks.values()] == [
        ("i0.png", "P1", mark["x"])
    ]
    assert json.loads(served.ask("undo", last(served, "undo"))[1])["marks"] == []
    assert read_marks(served.marks).marks == {}
    assert len(json.loads(served.ask("redo", last(served, "redo"))[1])["marks"]) == 1
    assert served.ask("fit/0/P1.png")[1].startswith(b"\x89PNG")
    assert served.ask("delete", {"point": "P1"})[0] == 200


def test_five_dots_orient_two_photographs_and_the_others_are_proposed(served: Served) -> None:
    names = [click(served, 0, dot)["mark"]["point"] for dot in range(6)]
    for dot, name in enumerate(names):
        click(served, 1, dot, name)
    state = served.state()
    while state["adjustment"]["state"] == "running":
        state = served.state(f"state?after={state['version']}")
    assert [photograph["oriented"] for photograph in state["photographs"]] == [True, True, False]
    new = click(served, 0, 7)["mark"]["point"]
    assert {line["image"] for line in served.state()["lines"]} == {1}
    assert len(json.loads(served.ask("sight?image=0&x=300&y=200")[1])["lines"]) == 1
    for image, dots in ((2, range(4)),):
        for dot in dots:
            click(served, image, dot, names[dot])
    state = served.state()
    while state["adjustment"]["state"] == "running":
        state = served.state(f"state?after={state['version']}")
    assert all(photograph["oriented"] for photograph in state["photographs"])
    before = state["version"]  # of the adjustment that did not propose it yet
    click(served, 1, 7, new)
    proposed = {(row["image"], row["point"]): row for row in served.state()["proposals"] if row["measured"]}
    assert (2, new) in proposed
    x, y = served.dots[2, 7]
    assert np.hypot(proposed[2, new]["x"] - x, proposed[2, new]["y"] - y) < 0.2
    version = served.state()["version"]
    assert served.ask("refuse", {"image": 2, "point": new, "version": before})[0] == 422
    assert served.ask("refuse", {"image": 2, "point": new, "version": version})[0] == 200
    assert (2, new) not in {(row["image"], row["point"]) for row in served.state()["proposals"]}
    assert served.ask("undo", last(served, "undo"))[0] == 200
    assert served.ask("accept", {"version": served.state()["version"]})[0] == 200
    assert any(row["image"] == 2 and row["point"] == new for row in served.state()["marks"])
    assert served.ask("rename", {"point": new, "name": names[0]})[0] == 422
    assert served.ask("rename", {"point": new, "name": "bolt"})[0] == 200
    assert served.ask("control", {"point": "bolt", "X": 1, "Y": 2, "Z": 3, "sigma": [0, 0, 0]})[0] == 200
    assert served.ask("bar", {"start": names[0], "end": "bolt", "length": 2.0, "sigma": 0.1})[0] == 200
    saved = read_marks(served.marks)
    assert saved.control["bolt"].xyz == (1.0, 2.0, 3.0)
    assert (names[0], "bolt") in saved.bars


def test_tiles_are_those_of_a_deep_zoom(served: Served) -> None:
    assert b'Width="770" Height="520"' in served.ask("tiles/0.dzi")[1]
    for level, column, row in ((10, 0, 0), (10, 1, 1), (6, 0, 0), (0, 0, 0)):
        assert served.ask(f"tiles/0_files/{level}/{column}_{row}.jpg")[1].startswith(b"\xff\xd8")
    for path in (
        "tiles/9.dzi",
        "tiles/0_files/11/0_0.jpg",
        "tiles/0_files/10/9_0.jpg",
        "tiles/9_files/0/0_0.jpg",
    ):
        assert served.ask(path)[0] == 404


@pytest.mark.parametrize("path", ["state", "", "tiles/0.dzi", "mark.js", "fit/0/P1.png"])
def test_a_wrong_secret_finds_nothing(served: Served, path: str) -> None:
    right = served.server.address.secret
    for wrong in ("x", right[:-1], right + "x", right.swapcase(), "%00", ".."):
        assert served.ask(path, secret=wrong)[0] == 404
    assert served.ask("click", {"image": 0, "x": 1, "y": 1}, secret="x")[0] == 404


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1", "http://127.0.0.1:1"])
def test_a_foreign_origin_is_refused(served: Served, origin: str) -> None:
    assert served.ask("state", Origin=origin)[0] == 403
    assert served.ask("undo", {}, Origin=origin)[0] == 403
    assert served.ask("state", Sec_Fetch_Site="cross-site")[0] == 403
    own = f"http://127.0.0.1:{served.server.address.port}"
    assert served.ask("state", Origin=own, Sec_Fetch_Site="same-origin")[0] == 200


def test_dns_rebinding_is_refused(served: Served) -> None:
    port = served.server.address.port
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1.evil.example:{port}", None):
        assert served.ask("state", Host=host)[0] in (400, 403)
    assert served.ask("state", Host=f"localhost:{port}")[0] == 200


def test_what_a_page_of_another_site_can_send_changes_nothing(served: Served) -> None:
    before = served.marks.read_bytes()
    body = {"image": 0, "x": 100.0, "y": 100.0, "kind": "hand"}
    assert served.ask("click", body, X_Kolinear=None)[0] == 403
    assert served.ask("click", body, X_Kolinear="guess")[0] == 403
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", None):
        assert served.ask("click", body, Content_Type=kind)[0] == 403
    assert served.ask("click")[0] == 404  # GET
    assert served.marks.read_bytes() == before


@pytest.mark.parametrize(
    "path",
    [
        "../../etc/passwd",
        "..%2f..%2fetc%2fpasswd",
        "mark.js/../../server.py",
        "%2e%2e/server.py",
        "tiles/..%2f0.dzi",
        "tiles/-1.dzi",
        "tiles/0_files/10/../../0.dzi",
        "fit/0/..%2f..%2fmarks.csv.png",
        "server.py",
        "mark.html",
        "state/",
        "openapi.json",
    ],
)
def test_paths_lead_to_nothing_else(served: Served, path: str) -> None:
    assert served.ask(path)[0] == 404


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"{",
        {"image": -1, "x": 1, "y": 1},
        {"image": 0, "x": 1e30, "y": 1},
        {"image": 0, "x": 1, "y": 1, "more": 1},
        {"image": 99, "x": 1, "y": 1},
        {"image": 0, "x": 1, "y": 1, "point": "\u202e"},
        {"image": 0, "x": 1, "y": 1, "kind": "all"},
        b'{"image": 0, "x": NaN, "y": 1}',
    ],
)
def test_wrong_requests_are_refused_with_a_reason(served: Served, body: Any) -> None:
    status, content = served.ask("click", body)
    assert status == 422
    assert json.loads(content)["error"]


def test_a_large_request_is_refused(served: Served) -> None:
    assert served.ask("click", b" " * 200_000)[0] == 413


def test_pages_load_nothing_from_elsewhere_and_are_in_no_frame(served: Served) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", served.server.address.port, timeout=30)
    connection.request("GET", f"/{served.server.address.secret}/state")
    headers = connection.getresponse().headers
    policy = headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy
    assert headers["Referrer-Policy"] == "no-referrer"  # the secret stays in the address
    assert "Access-Control-Allow-Origin" not in headers
    connection.close()


def test_only_this_computer_is_served_and_every_server_has_its_secret(served: Served, tmp_path: Path) -> None:
    assert served.server.socket.getsockname()[0] == "127.0.0.1"
    other = MarkingServer(served.server.session)
    assert other.address.secret != served.server.address.secret
    assert len(other.address.secret) >= 32  # another user of the computer can only guess
    other.socket.close()


def test_a_taken_port_is_named(served: Served) -> None:
    with pytest.raises(OutputError, match="another program has it"):
        MarkingServer(served.server.session, served.server.address.port)


def test_a_second_server_for_the_same_marks_is_refused(served: Served) -> None:
    with pytest.raises(FolderInUseError, match="another 'kolinear mark'"):
        MarkingSession(served.server.session.project, served.marks)


def test_the_marks_of_another_survey_are_left_alone(served: Served, tmp_path: Path) -> None:
    write_marks(tmp_path / "marks.csv", Marking("another hall"))
    before = (tmp_path / "marks.csv").read_bytes()
    with pytest.raises(SurveyFileError, match="another hall"):
        MarkingSession(served.server.session.project, tmp_path / "marks.csv")
    assert (tmp_path / "marks.csv").read_bytes() == before
