"""The download of the NGSIM portal, against a portal on this machine."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import pytest

from lcc_rl.commands import fetch as fetch_ngsim
from lcc_rl.data.ngsim import read_ngsim

Capture = pytest.CaptureFixture[str]
HEADER = (
    '"vehicle_id","frame_id","total_frames","global_time","local_x","local_y","global_x",'
    '"global_y","v_length","v_width","v_class","v_vel","v_acc","lane_id","o_zone","d_zone",'
    '"int_id","section_id","direction","movement","preceding","following","space_headway",'
    '"time_headway","location"'
)


def line(vehicle: int, location: str) -> str:
    values = [vehicle, 5, 9, 1113433135800, 18, 40.5, 0, 0, 15, 6, 2, 30, 1, 2]
    cells = [*values, "", "", "", "", "", "", 0, 0, 0, 0, location]
    return ",".join(f'"{cell}"' for cell in cells)


class Portal(ThreadingHTTPServer):
    """A small Socrata: 25 rows of I-80 and 10 of US-101; ``answer`` may spoil an answer."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.table = [("i-80", n) for n in range(1, 26)] + [("us-101", n) for n in range(1, 11)]
        self.asked: list[dict[str, str]] = []
        self.spoil: Callable[[dict[str, str], bytes], tuple[int, bytes, int]] | None = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def pages(self) -> list[str]:
        return [query["$offset"] for query in self.asked if "$offset" in query]


class Handler(BaseHTTPRequestHandler):
    server: Portal

    def do_GET(self) -> None:
        address = urlparse(self.path)
        query = {name: values[0] for name, values in parse_qs(address.query).items()}
        self.server.asked.append(query)
        where = query.get("$where", "")
        rows = [row for row in self.server.table if not where or where == f"location='{row[0]}'"]
        if address.path == "/resource/8ect-6jqj.json":
            assert query["$select"] == "count(*) as rows"
            content = json.dumps([{"rows": str(len(rows))}]).encode()
        else:
            assert address.path == "/resource/8ect-6jqj.csv"
            assert query["$order"] == ":id"
            start = int(query["$offset"])
            page = rows[start : start + int(query["$limit"])]
            content = "\n".join([HEADER, *(line(n, place) for place, n in page), ""]).encode()
        status, length = 200, len(content)
        if self.server.spoil is not None:
            status, content, length = self.server.spoil(query, content)
        self.send_response(status)
        self.send_header("Content-Length", str(length))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def portal() -> Iterator[Portal]:
    with Portal() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def run(portal: Portal, output: Path, *options: str) -> int:
    common = ["--base-url", portal.url, "--output", str(output), "--page-rows", "10"]
    return int(fetch_ngsim.main([*common, "--pause", "0.01", "--retries", "2", *options]))


def ids(path: Path) -> list[int]:
    lines = path.read_text().splitlines()
    assert lines[0] == HEADER
    return [int(row.split(",")[0].strip('"')) for row in lines[1:]]


def test_a_location_arrives_whole_and_is_readable(
    portal: Portal, tmp_path: Path, capsys: Capture
) -> None:
    output = tmp_path / "new" / "i80.csv"
    assert run(portal, output, "--location", "i-80") == 0
    assert ids(output) == list(range(1, 26))
    assert portal.pages() == ["0", "10", "20"]
    assert [path.name for path in output.parent.iterdir()] == ["i80.csv"]
    samples = read_ngsim(output).samples
    assert samples["recording"].unique().tolist() == ["i-80@2005-04-13T22:58:55Z"]
    printed = capsys.readouterr().out
    assert "10 of 25 rows (40.0%)" in printed
    assert "rows/s" in printed
    assert "min left" in printed


def test_all_locations(portal: Portal, tmp_path: Path) -> None:
    assert run(portal, tmp_path / "all.csv") == 0
    assert len(ids(tmp_path / "all.csv")) == 35


def fail_from(offset: int, status: int = 503) -> Callable[..., tuple[int, bytes, int]]:
    def spoil(query: dict[str, str], content: bytes) -> tuple[int, bytes, int]:
        if int(query.get("$offset", 0)) < offset:
            return 200, content, len(content)
        return status, b"no", 2

    return spoil


def test_an_interrupted_download_is_resumed(
    portal: Portal, tmp_path: Path, capsys: Capture
) -> None:
    output = tmp_path / "i80.csv"
    portal.spoil = fail_from(20)
    assert run(portal, output, "--location", "i-80") == 1
    assert not output.exists()
    assert portal.pages() == ["0", "10", "20", "20", "20"]  # tried three times
    assert "failed 3 times, last: 503" in capsys.readouterr().err
    with open(tmp_path / ".i80.csv.part", "ab") as file:
        file.write(b'"half a pa')  # a page that was cut off while it was written
    portal.spoil, portal.asked = None, []
    assert run(portal, output, "--location", "i-80") == 0
    assert portal.pages() == ["20"]
    assert ids(output) == list(range(1, 26))
    assert "resuming from 20 of 25 rows" in capsys.readouterr().out


def test_a_partial_file_of_another_query_is_not_continued(portal: Portal, tmp_path: Path) -> None:
    output = tmp_path / "file.csv"
    portal.spoil = fail_from(20)
    assert run(portal, output, "--location", "i-80") == 1
    portal.spoil = None
    assert run(portal, output, "--location", "us-101") == 0
    assert ids(output) == list(range(1, 11))


@pytest.mark.parametrize("state", ["", "{}", "[1]", '{"query": 1, "total": 25, "x": 2}'])
def test_a_damaged_state_begins_again(portal: Portal, tmp_path: Path, state: str) -> None:
    (tmp_path / ".i80.csv.state").write_text(state)
    (tmp_path / ".i80.csv.part").write_text("junk")
    assert run(portal, tmp_path / "i80.csv", "--location", "i-80") == 0
    assert ids(tmp_path / "i80.csv") == list(range(1, 26))


def test_failures_that_pass_are_retried(portal: Portal, tmp_path: Path) -> None:
    failures = iter([(500, b"", 0), (200, b"cut", 900), (429, b"", 0), (200, b"", 50)])

    def spoil(query: dict[str, str], content: bytes) -> tuple[int, bytes, int]:
        return (
            (200, content, len(content))
            if len(portal.asked) % 2 == 0
            else next(failures, (200, content, len(content)))
        )

    portal.spoil = spoil
    assert run(portal, tmp_path / "i80.csv", "--location", "i-80") == 0
    assert ids(tmp_path / "i80.csv") == list(range(1, 26))
    assert next(failures, None) is None


def test_refusals_are_not_retried(portal: Portal, tmp_path: Path, capsys: Capture) -> None:
    portal.spoil = fail_from(0, status=404)
    assert run(portal, tmp_path / "i80.csv") == 1
    assert len(portal.asked) == 1
    assert "404" in capsys.readouterr().err


def short(query: dict[str, str], content: bytes) -> tuple[int, bytes, int]:
    """Every page lacks its last row, and the last rows never come."""
    if "$offset" in query and int(query["$offset"]) >= 9:
        content = HEADER.encode() + b"\n"
    elif "$offset" in query:
        content = b"\n".join(content.split(b"\n")[:-2]) + b"\n"
    return 200, content, len(content)


def generous(query: dict[str, str], content: bytes) -> tuple[int, bytes, int]:
    """Pages have a row more than was asked for."""
    if "$offset" in query:
        content += content.split(b"\n")[1] + b"\n"
    return 200, content, len(content)


def forgetful(query: dict[str, str], content: bytes) -> tuple[int, bytes, int]:
    """Every page is the first one, as many rows as were asked for."""
    if "$offset" in query:
        rows = [HEADER, *(line(n, "i-80") for n in range(1, int(query["$limit"]) + 1)), ""]
        content = "\n".join(rows).encode()
    return 200, content, len(content)


def spoilt(cell: bytes) -> Callable[..., tuple[int, bytes, int]]:
    """The second page holds a cell of another kind."""

    def spoil(query: dict[str, str], content: bytes) -> tuple[int, bytes, int]:
        if query.get("$offset") == "10":
            content = content.replace(b'"i-80"', cell, 1)
        return 200, content, len(content)

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (forgetful, "the page from row 10 begins like page 1: the server ignores $offset"),
        (spoilt(b'"\xff"'), "from row 10: the answer is not a CSV table: 'utf-8' codec"),
        (spoilt(b'"' + b"x" * 200_000 + b'"'), "from row 10: the answer is not a CSV table: field"),
        (short, "9 rows arrived but the portal counts 25"),
        (generous, "26 rows arrived but the portal counts 25"),
        (lambda query, content: (200, b"<html>", 6), "unexpected answer to a count: b'<html>'"),
        (
            lambda query, content: (
                (200, content, len(content)) if "$select" in query else (200, b"<html>", 6)
            ),
            "the answer is not the NGSIM table; it begins b'<html>'",
        ),
        (
            lambda query, content: (200, b'[{"rows": "0"}]', 15),
            "the portal has no such rows",
        ),
    ],
)
def test_a_wrong_answer_never_becomes_the_file(
    portal: Portal,
    tmp_path: Path,
    capsys: Capture,
    spoil: Callable[..., tuple[int, bytes, int]],
    message: str,
) -> None:
    output = tmp_path / "i80.csv"
    portal.spoil = spoil
    assert run(portal, output, "--location", "i-80") == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not output.exists()
    portal.spoil = None  # and the next attempt succeeds
    assert run(portal, output, "--location", "i-80") == 0
    assert sorted(set(ids(output))) == list(range(1, 26))
    assert len(ids(output)) == 25


def test_no_connection(tmp_path: Path, capsys: Capture) -> None:
    arguments = ["--base-url", "http://127.0.0.1:9", "--output", str(tmp_path / "x.csv")]
    assert fetch_ngsim.main([*arguments, "--retries", "1", "--pause", "0.01"]) == 1
    error = capsys.readouterr().err
    assert "http://127.0.0.1:9/resource/8ect-6jqj.json" in error
    assert "failed 2 times" in error


def test_an_existing_file_is_kept(portal: Portal, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "i80.csv").write_text("mine")
    assert run(portal, tmp_path / "i80.csv") == 1
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "i80.csv").read_text() == "mine"
