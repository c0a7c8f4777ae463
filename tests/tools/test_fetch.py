"""The download of the NGSIM portal, against a portal on this machine."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import pytest

from lcc_rl.commands import fetch
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.errors import ConfigError, DataError

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
    """A small Socrata: 25 rows of I-80 and 10 of US-101; ``spoil`` may change an answer."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.table = [("i-80", n) for n in range(1, 26)] + [("us-101", n) for n in range(1, 11)]
        self.offsets: list[str] = []
        self.spoil: Callable[[str | None, bytes], bytes | None] = lambda offset, content: content


class Handler(BaseHTTPRequestHandler):
    server: Portal

    def do_GET(self) -> None:
        query = {name: values[0] for name, values in parse_qs(urlparse(self.path).query).items()}
        where, offset = query.get("$where", ""), query.get("$offset")
        rows = [row for row in self.server.table if not where or where == f"location='{row[0]}'"]
        if offset is None:
            content = json.dumps([{"rows": str(len(rows))}]).encode()
        else:
            assert query["$order"] == ":id"
            self.server.offsets.append(offset)
            page = rows[int(offset) : int(offset) + int(query["$limit"])]
            content = "\n".join([HEADER, *(line(n, place) for place, n in page), ""]).encode()
        answer = self.server.spoil(offset, content)
        self.send_response(503 if answer is None else 200)
        self.send_header("Content-Length", str(len(answer or b"")))
        self.end_headers()
        self.wfile.write(answer or b"")

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def portal() -> Iterator[Portal]:
    pytest.importorskip("pooch", reason="extra fetch")
    with Portal() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def run(portal: Portal, output: Path, *options: str) -> int:
    url = f"http://127.0.0.1:{portal.server_address[1]}"
    common = ["--base-url", url, "--output", str(output), "--page-rows", "10", "--retries", "0"]
    return fetch.main([*common, *options])


def ids(path: Path) -> list[int]:
    first, *rows = path.read_text().splitlines()
    assert first == HEADER
    return [int(row.split(",")[0].strip('"')) for row in rows]


def test_a_location_arrives_whole_and_is_readable(portal, tmp_path) -> None:
    output = tmp_path / "new" / "i80.csv"
    assert run(portal, output, "--location", "i-80") == 0
    assert ids(output) == list(range(1, 26))
    assert [path.name for path in output.parent.iterdir()] == ["i80.csv"]
    samples = read_ngsim(output).samples
    assert samples["recording"].unique().tolist() == ["i-80@2005-04-13T22:58:55Z"]


def test_an_interrupted_download_is_resumed(portal, tmp_path) -> None:
    output = tmp_path / "i80.csv"
    portal.spoil = lambda offset, content: None if offset == "20" else content
    with pytest.raises(DataError, match=r"503.*run the same command again to resume"):
        run(portal, output, "--location", "i-80")
    assert not output.exists()
    portal.spoil, portal.offsets = lambda offset, content: content, []
    assert run(portal, output, "--location", "i-80") == 0
    assert portal.offsets == ["20"]
    assert ids(output) == list(range(1, 26))


def first_page(offset: str | None, content: bytes) -> bytes:
    rows = [HEADER, *(line(n, "i-80") for n in range(1, 11)), ""]
    return content if offset is None else "\n".join(rows).encode()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (first_page, "in 1 different pages"),
        (lambda offset, content: b'[{"rows": "0"}]', "no such rows"),
        (lambda offset, content: content if offset is None else b"<html>", "the NGSIM table"),
        (
            lambda offset, content: f"{HEADER}\n".encode() if offset == "20" else content,
            "20 rows arrived",
        ),
    ],
)
def test_a_wrong_answer_never_becomes_the_file(portal, tmp_path, spoil, message) -> None:
    output = tmp_path / "i80.csv"
    portal.spoil = spoil
    with pytest.raises(DataError, match=message):
        run(portal, output, "--location", "i-80")
    assert not output.exists()
    portal.spoil = lambda offset, content: content
    assert run(portal, output, "--location", "i-80") == 0
    assert ids(output) == list(range(1, 26))


def test_without_pooch_one_line_names_the_extra(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(ConfigError, match=r"needs pooch: pip install -e '\.\[fetch\]'"):
        fetch.main(["--output", str(tmp_path / "i80.csv")])
