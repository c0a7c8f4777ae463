"""``python -m lcc_rl`` is the console command ``lcc-rl``."""

from lcc_rl.runs.interrupts import end_quietly

if __name__ == "__main__":
    end_quietly()  # here, because programs that import the package have their own handlers

    from lcc_rl.cli.console import main

    main()
