"""``python -m lcc_rl`` is the console command ``lcc-rl``."""

from lcc_rl.runs.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()  # here: a program that imports the package keeps its own handlers

    from lcc_rl.cli.console import main

    main()
