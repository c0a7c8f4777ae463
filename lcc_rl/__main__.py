"""``python -m lcc_rl`` is the console command ``lcc-rl``."""

from lcc_rl.cli.console import main

main()
