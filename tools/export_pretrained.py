"""Export a run's policy into the package: weights, configuration and provenance.

    python tools/export_pretrained.py outputs/train/<run> "3 of 8 seeds of …"

The configuration is exported without its paths.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from lcc_rl.cli.guard import main_guard
from lcc_rl.config.schemas import as_text
from lcc_rl.io.tensors import write_torch
from lcc_rl.results.policies import load_policy

LOCAL = ("data", "drivers", "leader", "split", "resume", "policy", "compare")
FOLDER = Path(__file__).parents[1] / "lcc_rl" / "assets" / "pretrained"


def export(run: str | Path, origin: str, folder: Path = FOLDER, name: str | None = None) -> Path:
    """Write the policy of a run into the package; return the file's path.

    Args:
        run: a run folder or policy file.
        origin: data, recipe and seed, in a sentence.
        folder: folder of the file.
        name: name of the file, without suffix; None: the variant's.
    """
    weights, cfg = load_policy(run)
    inputs = {
        kind: {Path(file).name: found for file, found in files.items()}
        for kind, files in cfg.inputs.items()
    }
    cfg = cfg.with_(**dict.fromkeys(x for x in LOCAL if hasattr(cfg, x)), inputs=inputs)
    path = folder / f"{name or cfg.variant}.pt"
    provenance = f"{origin}; lcc_rl {version('lcc_rl')}"
    content = {"weights": weights, "config": as_text(cfg), "provenance": provenance}
    write_torch(content, path)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Export a policy."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", help="run folder or policy.pt")
    parser.add_argument("origin", help="data, recipe and seed, in a sentence")
    parser.add_argument("--name", help="name of the file; by default the variant's")
    options = parser.parse_args(arguments)
    print(export(options.run, options.origin, name=options.name))
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
