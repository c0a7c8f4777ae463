"""Download the official NGSIM export of the US Department of Transportation, page by page.

    lcc-rl fetch --location i-80 --output data/ngsim_i80.csv

The portal holds 11.8 million rows of four locations. pooch downloads the pages into a folder beside
the output; the same command resumes an interrupted download. The file gets its name only when it is
complete, with as many rows as the portal counts. It is read by ``data=ngsim``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

from pydantic import Field

from lcc_rl.errors import ConfigError, DataError, how_to_install
from lcc_rl.io.atomic import atomic_path, new_file
from lcc_rl.runs.arguments import Arguments, typed
from lcc_rl.settings import Million

BASE_URL = "https://data.transportation.gov"
DATASET = "8ect-6jqj"
LOCATIONS = ("i-80", "us-101", "lankershim", "peachtree")
PAGE_ROWS, RETRIES = 50_000, 6


def fetch(
    output: Path,
    location: str | None = None,
    base_url: str = BASE_URL,
    page_rows: int = PAGE_ROWS,
    retries: int = RETRIES,
) -> int:
    """Download a table; pages that an interrupted download left are not asked for again.

    Args:
        output: the file, written completely or not at all.
        location: one of :data:`LOCATIONS`; None for all four.
        base_url: scheme and host of the portal.
        page_rows: rows per request.
        retries: how often a failed request is repeated.

    Returns:
        The number of rows downloaded.
    """
    try:
        import pooch
    except ModuleNotFoundError:
        raise ConfigError(f"lcc-rl fetch needs pooch: {how_to_install('fetch')}") from None
    folder = output.with_name(f".{output.name}.pages")
    where = {} if location is None else {"$where": f"location='{location}'"}

    def get(kind: str, name: str, query: dict[str, Any]) -> Path:
        url = f"{base_url}/resource/{DATASET}.{kind}?{urlencode({**query, **where})}"
        portal = pooch.create(folder, "", registry={name: None}, urls={name: url})
        portal.retry_if_failed = retries
        try:
            return Path(portal.fetch(name, downloader=pooch.HTTPDownloader(timeout=120)))
        except (OSError, ValueError) as error:  # errors of requests are OSErrors
            raise DataError(f"{error}; run the same command again to resume") from error

    (folder / "count.json").unlink(missing_ok=True)
    total = counted(get("json", "count.json", {"$select": "count(*) as rows"}))
    pages = []
    for offset in range(0, total, page_rows):
        # Without an order, the portal may repeat and leave out rows between pages.
        query = {"$limit": min(page_rows, total - offset), "$offset": offset, "$order": ":id"}
        name = f"{location or 'all'}-{total}-{page_rows}-{offset}.csv"
        pages.append(get("csv", name, query))
    try:
        joined(pages, total, output)
    except DataError:  # pages that do not fit together cannot be resumed from
        shutil.rmtree(folder)
        raise
    shutil.rmtree(folder)
    return total


def counted(path: Path) -> int:
    """Return the number of rows that the portal counts, from its answer."""
    try:
        total = int(json.loads(path.read_bytes())[0]["rows"])
    except (ValueError, LookupError, TypeError) as error:
        found = path.read_bytes()[:200]
        raise DataError(f"the portal answered {found!r}, expected a count of rows") from error
    if total == 0:
        raise DataError("the portal has no such rows")
    return total


def joined(pages: Sequence[Path], total: int, output: Path) -> None:
    """Write the pages as one file with one header, if they hold so many rows."""
    firsts, rows = set(), 0
    with atomic_path(output) as part, open(part, "wb") as file:
        for page in pages:
            header, _, body = page.read_bytes().removeprefix(b"\xef\xbb\xbf").partition(b"\n")
            if b"vehicle_id" not in header.lower():
                raise DataError(f"the portal answered {header[:200]!r}, expected the NGSIM table")
            if body and not body.endswith(b"\n"):
                body += b"\n"
            firsts.add(body.partition(b"\n")[0])
            rows += body.count(b"\n")
            file.write(body if page != pages[0] else header + b"\n" + body)
        if rows != total or len(firsts) != len(pages):
            raise DataError(
                f"{output}: {rows:,} rows arrived in {len(firsts)} different pages, expected "
                f"{total:,} rows in {len(pages)}; run the same command again"
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = Arguments(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--location", choices=LOCATIONS, help="one location (default: all four)")
    parser.add_argument("--output", type=Path, default=Path("data/ngsim.csv"), help="the CSV file")
    parser.add_argument(
        "--page-rows", type=typed(Million), default=PAGE_ROWS, help="rows per request"
    )
    parser.add_argument(
        "--retries",
        type=typed(Annotated[int, Field(ge=0, le=1000)]),
        default=RETRIES,
        help="per request",
    )
    parser.add_argument("--base-url", default=BASE_URL, help="another portal")
    options = parser.parse_args(arguments)
    rows = fetch(
        new_file(options.output, "--output"),
        options.location,
        options.base_url.rstrip("/"),
        options.page_rows,
        options.retries,
    )
    print(f"{options.output}: {rows:,} rows")
    return 0
