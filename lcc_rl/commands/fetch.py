"""Download the official NGSIM export of the US Department of Transportation, page by page.

    lcc-rl fetch --location i-80 --output data/ngsim_i80.csv

The portal holds 11.8 million rows of four locations. The download is paged; the same command
resumes an interrupted one. The file gets its name only when it is complete, with as many rows as
the portal counts. It is read by ``data=ngsim``.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import http.client
import io
import json
import os
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

BASE_URL = "https://data.transportation.gov"
DATASET = "8ect-6jqj"
LOCATIONS = ("i-80", "us-101", "lankershim", "peachtree")
PAGE_ROWS = 50_000
GIVE_UP = (400, 401, 403, 404)  # not worth a retry


class FetchError(Exception):
    """A download that failed."""


@dataclass
class State:
    """Progress of a download, kept beside the partial file.

    Args:
        query: what is being downloaded; a partial file of another query is discarded.
        total: rows that the portal counts.
        rows: rows in the partial file.
        size: bytes of the partial file up to the last whole page.
        firsts: checksums of the first row of every page.
    """

    query: str
    total: int
    rows: int = 0
    size: int = 0
    firsts: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Portal:
    """The portal's interface.

    Args:
        base_url: scheme and host.
        dataset: identifier of the dataset.
        location: location to download; None for all four.
        retries: how often a failed request is repeated.
        pause_s: pause before the first repetition [s]; it doubles with each.
        timeout_s: time limit of one request [s].
    """

    base_url: str = BASE_URL
    dataset: str = DATASET
    location: str | None = None
    retries: int = 6
    pause_s: float = 2.0
    timeout_s: float = 120.0

    @property
    def query(self) -> str:
        """What is downloaded, as one line."""
        return f"{self.base_url} {self.dataset} {self.location or 'all locations'}"

    def count(self) -> int:
        """Number of rows that the portal has."""
        text = self.get("json", {"$select": "count(*) as rows"})
        try:
            return int(json.loads(text)[0]["rows"])
        except (ValueError, LookupError, TypeError) as error:
            message = f"{self.base_url}: unexpected answer to a count: {text[:200]!r}"
            raise FetchError(message) from error

    def page(self, offset: int, rows: int) -> bytes:
        """One page of the table as CSV with a header."""
        # Without an order, Socrata may repeat and leave out rows between pages.
        return self.get("csv", {"$limit": str(rows), "$offset": str(offset), "$order": ":id"})

    def get(self, kind: str, query: dict[str, str]) -> bytes:
        """Answer to one request, repeated while the failure may pass."""
        if self.location is not None:
            query = {**query, "$where": f"location='{self.location}'"}
        text = urllib.parse.urlencode(query)
        url = f"{self.base_url}/resource/{self.dataset}.{kind}?{text}"
        for attempt in range(self.retries + 1):
            try:
                with urllib.request.urlopen(url, timeout=self.timeout_s) as answer:
                    return self._whole(answer)
            except urllib.error.HTTPError as error:
                failure = f"{error.code} {error.reason}"
                error.close()
                if error.code in GIVE_UP:
                    raise FetchError(f"{url}: {failure}") from error
            except (OSError, http.client.HTTPException, ValueError) as error:
                failure = str(error) or type(error).__name__
            if attempt < self.retries:
                time.sleep(self.pause_s * 2**attempt)
        raise FetchError(
            f"{url}: failed {self.retries + 1} times, last: {failure}. Run the same command again "
            "to resume"
        )

    @staticmethod
    def _whole(answer: http.client.HTTPResponse) -> bytes:
        content = answer.read()
        promised = answer.headers.get("Content-Length")
        if promised is not None and int(promised) != len(content):
            raise OSError(f"{len(content)} of {promised} bytes arrived")
        return content


def fetch(portal: Portal, output: Path, page_rows: int = PAGE_ROWS) -> int:
    """Download a table, resuming from a partial file of the same query.

    Args:
        portal: the portal and location.
        output: the file, written completely or not at all.
        page_rows: rows per request.

    Returns:
        The number of rows downloaded.

    Raises:
        FetchError: if the portal does not deliver the table, with the rows that it counts.
    """
    partial = output.with_name(f".{output.name}.part")
    state_file = output.with_name(f".{output.name}.state")
    output.parent.mkdir(parents=True, exist_ok=True)
    total = portal.count()
    if total == 0:
        raise FetchError(f"{portal.query}: the portal has no such rows")
    state = _resumed(state_file, partial, State(portal.query, total))
    already, start = state.rows, time.monotonic()
    with open(partial, "r+b" if state.rows else "wb") as file:
        file.truncate(state.size)
        file.seek(state.size)
        while state.rows < total:
            page = portal.page(state.rows, min(page_rows, total - state.rows))
            rows, header, text = _rows_of(page, f"{portal.query}, from row {state.rows:,}")
            if not rows:
                break
            _check_new(text, state, portal)
            file.write(text := text if state.rows else header + text)
            file.flush()
            os.fsync(file.fileno())
            state.rows, state.size = state.rows + rows, state.size + len(text)
            _save(state, state_file)
            print(_progress(state, state.rows - already, time.monotonic() - start))
    _check_whole(state, portal, state_file)
    os.replace(partial, output)
    state_file.unlink(missing_ok=True)
    return state.rows


def _resumed(state_file: Path, partial: Path, fresh: State) -> State:
    """State of a partial download of the same query, or a fresh one."""
    try:
        state = State(**json.loads(state_file.read_text()))
        whole = partial.stat().st_size >= state.size > 0
    except (OSError, ValueError, TypeError):
        return fresh
    if state.query != fresh.query or state.total != fresh.total or not whole:
        print("the partial file is of another download or damaged: starting again")
        return fresh
    print(f"resuming from {state.rows:,} of {state.total:,} rows")
    return state


def _save(state: State, path: Path) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(json.dumps(asdict(state)))
    os.replace(temporary, path)


def _check_new(text: bytes, state: State, portal: Portal) -> None:
    """Check that a page does not begin as an earlier one does, and remember its first row."""
    first = hashlib.sha256(text.partition(b"\n")[0]).hexdigest()[:16]
    if first in state.firsts:
        raise FetchError(
            f"{portal.query}: the page from row {state.rows:,} begins like page "
            f"{state.firsts.index(first) + 1}: the server ignores $offset or repeats rows"
        )
    state.firsts.append(first)


def _rows_of(page: bytes, source: str) -> tuple[int, bytes, bytes]:
    """Number of rows of a page, its header line and its rows."""
    text = page.removeprefix(b"\xef\xbb\xbf")
    first, _, body = text.partition(b"\n")
    names = first.decode("utf-8", "replace").lower().replace('"', "")
    if "vehicle_id" not in names or "frame_id" not in names:
        raise FetchError(f"{source}: the answer is not the NGSIM table; it begins {text[:200]!r}")
    if body and not body.endswith(b"\n"):
        body += b"\n"
    try:
        rows = sum(1 for row in csv.reader(io.StringIO(body.decode("utf-8"))) if row)
    except (UnicodeDecodeError, csv.Error) as error:
        raise FetchError(f"{source}: the answer is not a CSV table: {error}") from error
    return rows, first + b"\n", body


def _progress(state: State, fetched: int, seconds: float) -> str:
    rate = fetched / max(seconds, 1e-9)
    left = (state.total - state.rows) / rate
    return (
        f"{state.rows:,} of {state.total:,} rows ({state.rows / state.total:.1%}), "
        f"{rate:,.0f} rows/s, {left / 60:.1f} min left"
    )


def _check_whole(state: State, portal: Portal, state_file: Path) -> None:
    counted = portal.count()
    if state.rows > counted:
        state_file.unlink(missing_ok=True)  # too many rows: resuming cannot help
    if state.rows != counted:
        raise FetchError(
            f"{portal.query}: {state.rows:,} rows arrived but the portal counts {counted:,}. "
            "Run the same command again"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--location", choices=LOCATIONS, help="one location (default: all four)")
    parser.add_argument("--output", type=Path, default=Path("data/ngsim.csv"), help="the CSV file")
    parser.add_argument("--page-rows", type=int, default=PAGE_ROWS, help="rows per request")
    parser.add_argument("--retries", type=int, default=Portal.retries, help="per request")
    parser.add_argument("--pause", type=float, default=Portal.pause_s, help="first pause [s]")
    parser.add_argument("--base-url", default=BASE_URL, help="another portal, for tests")
    options = parser.parse_args(arguments)
    if options.page_rows < 1:
        parser.error("--page-rows must be at least 1")
    portal = Portal(
        options.base_url.rstrip("/"),
        location=options.location,
        retries=options.retries,
        pause_s=options.pause,
    )
    try:
        if options.output.exists():
            raise FetchError(f"{options.output}: exists already; remove it to download it again")
        rows = fetch(portal, options.output, options.page_rows)
    except (FetchError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; run the same command again to resume", file=sys.stderr)
        return 130
    print(f"{options.output}: {rows:,} rows")
    return 0
