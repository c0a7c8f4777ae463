#!/usr/bin/env bash
# Hydra 1.3.8: `recipe=[short,long]`, where short.yaml is built on long.yaml (its defaults list), is
# a mixture of both recipes, not what long.yaml says; no warning.
# Guess before: the last choice has the last word, so the settings are those of the long recipe.
# Seen: batch 1024 of long, exploration 0.7 of short, which changed it in a node of long alone.
# Hurt: ablations that put one recipe after another.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq hydra-core==1.3.8 || exit 2
cd "$folder"
mkdir -p conf/recipe
printf 'defaults:\n  - _self_\n  - recipe: null\nagent:\n  batch: 64\n' > conf/config.yaml
printf '# @package _global_\nagent:\n  batch: 1024\n  exploration:\n    share: 0.5\n' \
    > conf/recipe/long.yaml
printf '# @package _global_\ndefaults:\n  - long\n  - _self_\nagent:\n  batch: 256\n' \
    > conf/recipe/short.yaml
printf '  exploration:\n    share: 0.7\n' >> conf/recipe/short.yaml
venv/bin/python - <<'EOF'
import os
import sys

from hydra import compose, initialize_config_dir


def agent(recipe):
    with initialize_config_dir(f"{os.getcwd()}/conf", version_base="1.3"):
        found = compose("config", overrides=[f"recipe={recipe}"]).agent
    print(f"{recipe}: batch {found.batch}, exploration {found.exploration.share}")
    return found.batch, found.exploration.share


long, short, both = (agent(x) for x in ("long", "short", "[short,long]"))
sys.exit(0 if (long, short, both) == ((1024, 0.5), (256, 0.7), (1024, 0.7)) else 1)
EOF
