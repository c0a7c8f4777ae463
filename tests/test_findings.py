"""Scripts of findings/: form, and a row in their list; make findings runs them."""

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "findings").glob("*.sh"))


def test_form(subtests):
    for script in SCRIPTS:
        with subtests.test(script.stem):
            check_form(script)


def check_form(script):
    text = script.read_text(encoding="utf-8")
    head = re.match(r"#!/usr/bin/env bash\n((?:# .+\n)+)set -euo pipefail\n", text)
    assert head, "a head of comments, then set -euo pipefail"
    assert 3 <= len(head[1].splitlines()) <= 6
    assert "Guess before" in head[1].replace("\n# ", " ")
    assert re.search(r"pip install -qq (\\\s+)?(\S+==\S+ )+\|\| exit 2", text), "pinned packages"
    assert "lcc_rl" not in text
    assert max(map(len, text.splitlines())) <= 100
    subprocess.run(["bash", "-n", script], check=True)


def test_list():
    rows = re.findall(
        r"^\| \[(\w+)\]\(\1\.sh\) \|", (ROOT / "findings/README.md").read_text(), re.M
    )
    assert rows == [script.stem for script in SCRIPTS]
